"""Files for rerun, read by rerun's own reader."""

import json
import subprocess
import sys
from collections import defaultdict

import numpy as np
import pytest

import stillmap
from stillmap.cli.main import main
from stillmap.io import stillmap_folder
from stillmap.io.trajectory import read_tum

rerun = pytest.importorskip("rerun")


def convert(result, path):
    assert main(["convert", str(result), "-o", str(path), "--quiet"]) == 0
    return path


def rows(path):
    """Rows by entity, static ones under the key (entity,), in the order of the scans."""
    reader = rerun.chunk.RrdReader(str(path))
    [entry] = reader.recordings()
    assert entry.application_id == "stillmap"
    assert len(reader.blueprints()) == 1
    found = defaultdict(list)
    for chunk in reader.stream():
        key = (chunk.entity_path,) if chunk.is_static else chunk.entity_path
        found[key] += chunk.to_record_batch().to_pylist()
    for key, entries in found.items():
        if isinstance(key, str):
            entries.sort(key=lambda row: row["scan"])
    return found


def pose(row):
    """(4, 4) of a Transform3D; matrices are stored column by column."""
    T = np.eye(4)
    T[:3, :3] = np.array(row["Transform3D:mat3x3"][0]).reshape(3, 3).T
    T[:3, 3] = row["Transform3D:translation"][0]
    return T


@pytest.fixture(scope="module")
def of_hall(result):
    return rows(convert(result, result.parent / "hall.rrd"))


@pytest.fixture(scope="module")
def of_street(mapped_street):
    return rows(convert(mapped_street, mapped_street.parent / "street.rrd"))


def test_entities(of_hall, of_street):
    fixed = {("/map",), ("/map/plan",), ("/map/path",)}
    hall = {"/map/base", "/map/base/laser", "/map/base/laser2", "/map/objects"}
    assert set(of_hall) == fixed | hall | {("/map/base/laser",), ("/map/base/laser2",)}
    street = {"/map/base", "/map/base/lidar", "/map/objects"}
    assert set(of_street) == fixed | street | {("/map/base/lidar",), ("/map/static_points",)}


@pytest.mark.parametrize(("dimension", "first"), [(2, 1), (3, 3)])
def test_scans_without_returns(dimension, first, tmp_path):
    """The first ones, of which rerun would have to learn the type of the labels; or all."""
    angles = np.linspace(0.0, 2 * np.pi, 90, endpoint=False)
    if dimension == 2:
        ranges = np.tile(np.linspace(3.0, 4.0, 90), (3, 1))
        ranges[:first] = np.nan
        recording = stillmap.Recording.from_scans(np.arange(3.0), ranges, angles)
    else:
        recording = stillmap.Recording.from_clouds(np.arange(3.0), [np.zeros((0, 3))] * 3)
    stillmap_folder.write(recording, tmp_path / "recording")
    words = ["map", tmp_path / "recording", "-o", tmp_path / "map", "--quiet"]
    assert main([*map(str, words)]) == 0
    # in a process of its own: rerun remembers types
    words = [tmp_path / "map", "-o", tmp_path / "map.rrd", "--quiet"]
    command = [sys.executable, "-m", "stillmap", "convert", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    sensor = "/map/base/laser" if dimension == 2 else "/map/base/lidar"
    counts = [len(row["p_static"] or []) for row in rows(tmp_path / "map.rrd")[sensor]]
    assert counts == [0] * first + [90] * (3 - first)


@pytest.mark.parametrize("case", ["hall", "street"])
def test_timelines_and_poses(case, request):
    found = request.getfixturevalue(f"of_{case}")
    folder = request.getfixturevalue({"hall": "result", "street": "mapped_street"}[case])
    stamp_ns, poses = read_tum(folder / "trajectory.tum")
    base = found["/map/base"]
    assert [row["scan"] for row in base] == list(range(len(stamp_ns)))
    stamps = np.array([row["stamp"] for row in base], "datetime64[ns]").astype(np.int64)
    np.testing.assert_array_equal(stamps, stamp_ns)
    np.testing.assert_allclose([pose(row) for row in base], poses, atol=1e-5)
    [path] = found["/map/path",]
    [strip] = path["LineStrips3D:strips"]
    np.testing.assert_allclose(strip, poses[:, :3, 3], atol=1e-5)


def test_scans_are_those_of_the_labels(of_street, mapped_street):
    """Through base and lidar, the points with p_static of all scans are those of the clouds."""
    from stillmap.io.point_cloud import ply
    from stillmap.io.point_cloud.table import read_columns

    [mount] = of_street["/map/base/lidar",]
    points = []
    for base, scan in zip(of_street["/map/base"], of_street["/map/base/lidar"], strict=True):
        T = pose(base) @ pose(mount)
        xyz = np.array(scan["Points3D:positions"])
        points.append(np.column_stack([xyz @ T[:3, :3].T + T[:3, 3], scan["p_static"]]))
        assert len(scan["Points3D:colors"]) == len(xyz)
    found = np.concatenate(points)
    for part, chosen in (("static", found[:, 3] >= 0.5), ("dynamic", found[:, 3] < 0.5)):
        layout = ply.read_layout(mapped_street / f"{part}.ply")
        columns = read_columns(layout, ("x", "y", "z", "p_static"))
        expected = np.concatenate([np.stack(block, 1) for block in columns])
        assert len(expected) > 300
        np.testing.assert_allclose(found[chosen], expected, atol=1e-4)
    [static] = of_street["/map/static_points",]
    assert len(static["Points3D:positions"]) == (found[:, 3] >= 0.5).sum()


def test_colors_follow_the_labels(of_hall, result, recording):
    p_static, hit = np.load(result / "beams/p_static.npy"), recording.hit
    shown = defaultdict(list)
    for name in ("laser", "laser2"):
        for scan in of_hall[f"/map/base/{name}"]:
            beams = recording.beams_of(scan["scan"])
            np.testing.assert_array_equal(np.float32(scan["p_static"]), p_static[beams][hit[beams]])
            for p, rgba in zip(scan["p_static"], scan["Points3D:colors"], strict=True):
                shown[p < 0.5].append((rgba >> 24, rgba >> 8 & 255, p))
    dynamic, static = np.array(shown[True]), np.array(shown[False])
    assert (dynamic[:, 0] >= dynamic[:, 1]).all()  # more red than blue
    assert (static[:, 0] <= static[:, 1]).all()
    grey = dynamic[dynamic[:, 0] == dynamic[:, 1]]  # one of 256 levels nearer to one half
    assert (grey[:, 2] > 0.49).all()


@pytest.mark.parametrize("case", ["hall", "street"])
def test_boxes(case, request):
    found = request.getfixturevalue(f"of_{case}")
    folder = request.getfixturevalue({"hall": "result", "street": "mapped_street"}[case])
    objects = {o["id"]: o for o in json.loads((folder / "objects/objects.json").read_text())}
    stamp_ns, _ = read_tum(folder / "trajectory.tum")
    seen = set()
    for row in found["/map/objects"]:
        stamp = int(stamp_ns[row["scan"]])
        for k, label in enumerate(row["Boxes3D:labels"]):
            one = objects[int(label)]
            seen.add(one["id"])
            assert one["first_stamp_ns"] <= stamp <= one["last_stamp_ns"]
            half = np.array(row["Boxes3D:half_sizes"][k])
            flat = len(one["size"])
            np.testing.assert_allclose(2 * half[:flat], np.maximum(one["size"], 0.1), rtol=1e-5)
            track = one["track"]
            if stamp in track["stamp_ns"]:
                n = track["stamp_ns"].index(stamp)
                place = [track[axis][n] for axis in "xy"]
                center = row["Boxes3D:centers"][k]
                np.testing.assert_allclose(center[:2], place, atol=1e-4)
    assert seen == set(objects)
    assert len(seen) > 1


def test_plan_is_the_map(of_hall, result):
    [plan] = of_hall["/map/plan",]
    corners = np.array(plan["Mesh3D:vertex_positions"])
    with np.load(result / "map.npz") as archive:
        p, origin, edge = (archive[n] for n in ("p_occupied", "origin", "resolution"))
    [form] = plan["Mesh3D:albedo_texture_format"]
    width, height = form["width"], form["height"]
    [buffer] = plan["Mesh3D:albedo_texture_buffer"]
    picture = np.array(buffer, np.uint8).reshape(height, width, 3)
    (x0, y0, _), (x1, y1, _) = corners.min(axis=0), corners.max(axis=0)
    rows, columns = np.nonzero(p > 0.9)
    x, y = origin[0] + (columns + 0.5) * edge, origin[1] + (rows + 0.5) * edge
    across = ((x - x0) / (x1 - x0) * width).astype(int)
    down = ((y1 - y) / (y1 - y0) * height).astype(int)
    assert np.mean(picture[down, across].max(axis=1) < 64) > 0.9
    # texture coordinates run down the picture
    texture = np.array(plan["Mesh3D:vertex_texcoords"])
    np.testing.assert_array_equal(texture[:, 1] == 1, corners[:, 1] == y0)


@pytest.mark.slow
def test_same_content_again(mapped_street, tmp_path):
    """By rerun's own comparison, and both files are found to be whole."""
    first, second = (convert(mapped_street, tmp_path / f"{name}.rrd") for name in "ab")
    call = [sys.executable, "-m", "rerun", "rrd"]
    quiet = {"capture_output": True, "timeout": 60, "check": True}
    environment = {"PATH": "", "CI": "true", "HOME": str(tmp_path)}  # in CI rerun sends nothing
    subprocess.run([*call, "verify", first], env=environment, **quiet)
    subprocess.run([*call, "compare", "--unordered", first, second], env=environment, **quiet)


def test_early_stamps_are_durations(result, recording, tmp_path):
    """Of clocks that begin with the robot, dates would be of 1970."""
    import dataclasses
    import shutil

    from stillmap.io import stillmap_folder

    shift = int(recording.stamp_ns[0]) - 5 * 10**9
    early = dataclasses.replace(recording, stamp_ns=recording.stamp_ns - shift)
    stillmap_folder.write(early, tmp_path / "early")
    shutil.copytree(result, tmp_path / "out")
    np.save(tmp_path / "out/beams/stamp_ns.npy", early.stamp_ns)
    lines = (result / "trajectory.tum").read_text().splitlines()
    moved = [
        f"{stamp / 1e9:.9f} {line.split(' ', 1)[1]}"
        for line, stamp in zip(lines, early.stamp_ns.tolist(), strict=True)
    ]
    (tmp_path / "out/trajectory.tum").write_text("\n".join(moved) + "\n")
    words = ["convert", tmp_path / "out", "-o", tmp_path / "a.rrd", "--input", tmp_path / "early"]
    assert main([*map(str, words)]) == 0
    found = rows(tmp_path / "a.rrd")["/map/base"]
    seconds = [np.timedelta64(row["stamp"]).astype("timedelta64[ns]") for row in found]
    assert seconds[0] == np.timedelta64(5, "s")


def test_a_failing_write_leaves_nothing(result, tmp_path, monkeypatch, capsys):
    from stillmap.results.export import rrd

    class Full:
        def write(self, _):
            raise OSError(28, "No space left on device")

    init = rrd._Pipe.__init__
    monkeypatch.setattr(rrd._Pipe, "__init__", lambda self, _: init(self, Full()))
    assert main(["convert", str(result), "-o", str(tmp_path / "a.rrd"), "--quiet"]) == 2
    assert "a.rrd: cannot be written: No space left on device" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_without_rerun(result, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["convert", str(result), "-o", str(tmp_path / "a.rrd")]) == 2
    error = capsys.readouterr().err
    assert "a.rrd: needs rerun to be written (" in error
    assert "[rerun]" in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
