"""Point clouds of 3D results, read by other libraries."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import trimesh

from stillmap.cli.main import main
from stillmap.core.errors import InputError
from stillmap.io import read, stillmap_folder
from stillmap.io.point_cloud import pcd, ply
from stillmap.io.point_cloud.table import read_columns
from stillmap.results import point_cloud
from stillmap.results.export import point_cloud_files

FIELDS = ("x", "y", "z", "p_static")
ROUNDED = 0.5001e-4  # m


def of_ply(path: Path) -> np.ndarray:
    """(n, 4) FIELDS."""
    blocks = [np.stack(block, 1) for block in read_columns(ply.read_layout(path), FIELDS)]
    return np.concatenate([np.empty((0, 4), np.float32), *blocks])


def of_las(path: Path) -> np.ndarray:
    read_las = pytest.importorskip("laspy").read(path)
    assert read_las["p_static"].dtype == np.float32
    assert read_las.header.point_count == len(read_las.points)
    assert read_las.header.global_encoding.wkt
    return np.stack([read_las.x, read_las.y, read_las.z, read_las["p_static"]], axis=1)


def of_e57(path: Path) -> np.ndarray:
    file = pytest.importorskip("pye57").E57(str(path))
    assert file.scan_count == 1
    low, high = (
        [file.get_header(0)["cartesianBounds"][f"{a}{end}"].value() for a in "xyz"]
        for end in ("Minimum", "Maximum")
    )
    found = file.read_scan_raw(0)
    file.close()
    xyz = np.stack([found[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    np.testing.assert_allclose([xyz.min(axis=0), xyz.max(axis=0)], [low, high], atol=ROUNDED)
    return np.column_stack([xyz, found["intensity"]])


def of_pcd(path: Path) -> np.ndarray:
    blocks = read_columns(pcd.read_header(path)[0], list(FIELDS))
    rows = [np.stack(columns, axis=1) for columns in blocks]
    return np.concatenate([np.empty((0, len(FIELDS))), *rows])


def of_xyz(path: Path) -> np.ndarray:
    names, *lines = path.read_text().splitlines()
    assert names == " ".join(FIELDS)
    rows = np.array([line.split() for line in lines], np.float64).reshape(-1, 4)
    return np.column_stack([rows[:, :3], rows[:, 3].astype(np.float32)])


READERS = {
    ".las": of_las,
    ".laz": of_las,
    ".e57": of_e57,
    ".pcd": of_pcd,
    ".ply": of_ply,
    ".xyz": of_xyz,
}


@pytest.fixture
def converted(mapped_street, tmp_path):
    """Convert the street to a cloud."""

    def convert(ending: str, *more: str) -> Path:
        path = tmp_path / f"{'-'.join(more)}cloud{ending}"
        assert main(["convert", str(mapped_street), "-o", str(path), "--quiet", *more]) == 0
        return path

    return convert


def write(path: Path, block: point_cloud.Block, times: int = 1, progress=None) -> None:
    """A cloud of so many equal blocks, by the path's ending."""
    count = times * len(block.points)
    cloud = point_cloud.Cloud(count, np.zeros(3), None, lambda: iter([block] * times))
    form = point_cloud_files.format_for(path)
    point_cloud_files.write(cloud, path, form, progress)


def both(result: Path) -> dict[str, np.ndarray]:
    return {part: of_ply(result / f"{part}.ply") for part in ("static", "dynamic")}


@pytest.mark.parametrize("ending", READERS)
def test_points_equal_those_of_the_result(converted, mapped_street, ending):
    """Deskewed, as in the map."""
    found, known = READERS[ending](converted(ending)), both(mapped_street)
    assert len(known["dynamic"]) > 100
    moves = found[:, 3] < 0.5
    for part, its in (("static", found[~moves]), ("dynamic", found[moves])):
        np.testing.assert_allclose(its[:, :3], known[part][:, :3], atol=ROUNDED + 1e-5)
        np.testing.assert_array_equal(its[:, 3], known[part][:, 3])


@pytest.mark.slow
@pytest.mark.parametrize("ending", READERS)
@pytest.mark.parametrize("part", ["static", "dynamic"])
def test_static_or_dynamic_points_only(converted, mapped_street, ending, part):
    found = READERS[ending](converted(ending, "--only", part))
    known = both(mapped_street)[part]
    np.testing.assert_allclose(found, known, atol=ROUNDED + 1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("ending", READERS)
def test_files_are_reproducible(converted, ending):
    first = converted(ending).read_bytes()
    assert converted(ending, "--overwrite").read_bytes() == first


def test_deskewing_exceeds_rounding(street, mapped_street):
    """Otherwise the test above would not see deskewing."""
    recording = stillmap_folder.read(street)
    hits, poses = np.flatnonzero(recording.hit), np.load(street / "truth/T_world_base.npy")
    known, found = both(mapped_street), recording.end_points(hits, poses)
    moves = np.load(mapped_street / "beams/p_static.npy")[hits] < 0.5
    apart = np.linalg.norm(found[~moves] - known["static"][:, :3], axis=1)
    assert np.median(apart) > 0.1


def test_las_times(converted, street):
    laspy = pytest.importorskip("laspy")
    recording = stillmap_folder.read(street)
    scan = np.repeat(np.arange(recording.n_scans), np.diff(recording.offset))
    seconds = 1e-9 * recording.stamp_ns[scan] + recording.beam_time
    found = laspy.read(converted(".laz")).gps_time
    np.testing.assert_allclose(found, seconds[recording.hit], rtol=0, atol=1e-6)
    assert np.ptp(found) > 1.0


def test_other_readers(converted, mapped_street):
    n = sum(len(points) for points in both(mapped_street).values())
    assert trimesh.load(converted(".ply")).vertices.shape == (n, 3)
    for ending in (".pcd", ".e57", ".las"):
        assert read(converted(ending, "--overwrite")).n_beams == n


def test_tables_are_for_2d_only(mapped_street, tmp_path, capsys):
    assert main(["convert", str(mapped_street), "-o", str(tmp_path / "a.parquet")]) == 2
    assert "3D recording" in (said := capsys.readouterr().err)
    assert ".laz" in said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "form",
    [
        pytest.param(form, id=form.name, marks=[pytest.mark.slow] if form.name == "xyz" else [])
        for form in point_cloud_files.FORMATS
    ],
)
def test_memory_is_bounded(form, tmp_path):
    point_cloud_files.require_extras(form, tmp_path)
    n, shares = 1 << 14, []
    xyz = np.random.default_rng(0).uniform(-50.0, 50.0, (n, 3))
    block = point_cloud.Block(xyz, np.full(n, 0.75, np.float32), np.zeros(n, np.int64))
    tracemalloc.start()
    try:
        write(tmp_path / f"a{form.endings[0]}", block, 40, shares.append)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 5 * (n * 60), peak  # bytes: a few blocks of the forty
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


@pytest.mark.parametrize("form", point_cloud_files.FORMATS, ids=lambda form: form.name)
def test_empty_cloud(form, tmp_path):
    empty = point_cloud.Block(np.empty((0, 3)), np.empty(0, np.float32), None)
    path = tmp_path / f"a{form.endings[0]}"
    write(path, empty)
    if form.name != "e57":  # bounds of nothing are not to be had
        assert len(READERS[form.endings[0]](path)) == 0
    assert path.stat().st_size > 0


@pytest.mark.parametrize("name", ["a.las", "a.laz", "a.e57"])
def test_points_out_of_range_are_refused(name, tmp_path):
    far = np.full((3, 3), 3e5)
    with pytest.raises(InputError, match=f"{name}: cannot be written: a point is beyond"):
        write(tmp_path / name, point_cloud.Block(far, np.ones(3, np.float32), None))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("form", point_cloud_files.FORMATS, ids=lambda form: form.name)
def test_full_disk(form, tmp_path, limit_files):
    rng, n = np.random.default_rng(1), 20_000
    block = point_cloud.Block(rng.uniform(-50, 50, (n, 3)), rng.uniform(size=n).astype("f4"), None)
    path = tmp_path / f"a{form.endings[0]}"
    limit_files(100_000)
    with pytest.raises(InputError, match=f"{path.name}: cannot be written: "):
        write(path, block, 9)
    limit_files(None)
    assert list(tmp_path.iterdir()) == []
