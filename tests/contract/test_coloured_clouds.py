"""Colors of point clouds, read by other libraries."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from stillmap.io.point_cloud.ply import make_header
from stillmap.results import point_cloud
from stillmap.results.export import point_cloud_files
from stillmap.results.point_cloud import COLOURS, FIELDS, put_colours

N = 70_000


@pytest.fixture(scope="module")
def points() -> point_cloud.Block:
    rng = np.random.default_rng(3)
    colours = rng.integers(0, 256, (N, 3)).astype(np.uint8)
    colours[:3] = [[0, 0, 0], [255, 255, 255], [255, 0, 1]]
    xyz = rng.uniform(-40.0, 40.0, (N, 3))
    return point_cloud.Block(xyz, rng.uniform(size=N).astype(np.float32), np.arange(N), colours)


@pytest.fixture
def written(points, tmp_path):
    def write(ending: str, *, coloured: bool = True) -> Path:
        block = points if coloured else points._replace(colors=None)
        path = tmp_path / f"{'coloured' if coloured else 'plain'}{ending}"
        whole = point_cloud.Cloud(N, np.zeros(3), 0, lambda: iter([block]), coloured)
        point_cloud_files.write(whole, path, point_cloud_files.format_for(path))
        return path

    return write


@pytest.mark.parametrize("ending", [".las", ".laz"])
def test_las(written, points, ending):
    laspy = pytest.importorskip("laspy")
    found = laspy.read(written(ending))
    assert found.point_format.id == 7
    rgb = np.stack([found.red, found.green, found.blue], axis=1)
    np.testing.assert_array_equal(rgb, points.colors.astype(np.uint16) * 256)
    np.testing.assert_array_equal(found["p_static"], points.p_static)
    np.testing.assert_allclose(found.xyz, points.points, atol=0.51e-4)
    assert laspy.read(written(ending, coloured=False)).point_format.id == 6


def test_e57(written, points):
    pye57 = pytest.importorskip("pye57")
    file = pye57.E57(str(written(".e57")))
    found = file.read_scan(0, colors=True, intensity=True, ignore_missing_fields=True)
    limits = file.get_header(0)["colorLimits"]
    assert limits["colorRedMaximum"].value() == 255
    file.close()
    rgb = np.stack([found[f"color{name}"] for name in ("Red", "Green", "Blue")], axis=1)
    np.testing.assert_array_equal(rgb, points.colors)
    np.testing.assert_array_equal(found["intensity"], points.p_static)
    plain = pye57.E57(str(written(".e57", coloured=False)))
    assert "colorRed" not in plain.read_scan_raw(0)
    plain.close()


def test_ply(written, points):
    found = trimesh.load(written(".ply"))
    np.testing.assert_array_equal(found.colors[:, :3], points.colors)
    np.testing.assert_allclose(found.vertices, points.points, atol=4e-6)


def test_pcd(written, points):
    """As in PCL: four bytes in a float, blue first."""
    head, _, data = written(".pcd").read_bytes().partition(b"DATA binary\n")
    lines = dict(line.split(" ", 1) for line in head.decode().splitlines())
    assert lines["FIELDS"] == "x y z p_static rgb"
    assert (lines["SIZE"], lines["TYPE"]) == ("4 4 4 4 4", "F F F F F")
    rows = np.frombuffer(data, np.uint8).reshape(N, 20)
    np.testing.assert_array_equal(rows[:, 16:19], points.colors[:, ::-1])
    assert not rows[:, 19].any()
    # none of them is NaN, or readers would drop it
    assert np.isfinite(rows[:, 16:].copy().view("<f4")).all()


def test_text(written, points):
    path = written(".xyz")
    assert path.read_text().split("\n", 1)[0] == "x y z p_static red green blue"
    found = np.loadtxt(path, skiprows=1)
    np.testing.assert_array_equal(found[:, 4:], points.colors)
    np.testing.assert_array_equal(found[:, 3].astype(np.float32), points.p_static)
    np.testing.assert_allclose(found[:, :3], points.points, atol=0.51e-4)


def test_cloud_from_folder_has_colors(points, tmp_path):
    """A cloud has no colors if one of its parts has none."""
    rows = np.zeros(N, FIELDS + COLOURS)
    for name, column in zip("xyz", points.points.T, strict=True):
        rows[name] = column
    rows["p_static"] = np.where(np.arange(N) < 9, 0.1, 0.9)
    put_colours(rows, points.colors)
    for part, its in (("dynamic", rows[:9]), ("static", rows[9:])):
        head = make_header(FIELDS + COLOURS, len(its))
        (tmp_path / f"{part}.ply").write_bytes(head + its.tobytes())
    found = point_cloud.cloud_from_folder(tmp_path)
    assert found.has_colors
    colours = np.concatenate([block.colors for block in found.make_blocks()])
    np.testing.assert_array_equal(colours, np.roll(points.colors, -9, axis=0))
    plain = np.zeros(2, FIELDS)
    (tmp_path / "dynamic.ply").write_bytes(make_header(FIELDS, 2) + plain.tobytes())
    found = point_cloud.cloud_from_folder(tmp_path)
    assert not found.has_colors
    assert all(block.colors is None for block in found.make_blocks())
    assert point_cloud.cloud_from_folder(tmp_path, "static").has_colors
