"""`stillmap convert`: recordings in other formats, results for other programs."""

import json
import shutil
import sys

import numpy as np
import pytest
from refusals import refused
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from stillmap.core.errors import install_command
from stillmap.io import read, stillmap_folder
from stillmap.io.trajectory import read_tum


def topics_of(path):
    with AnyReader([path], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        return {c.topic: c.msgcount for c in reader.connections}


@pytest.mark.parametrize("name", ["a.log", "a.CLF", "a.txt", "a.log.gz"])
def test_to_a_log(call, room, tmp_path, nothing_left, name):
    done = call("convert", room, "-o", tmp_path / name)
    assert (done.returncode, done.stdout) == (0, "")
    assert "40 scans, 4800 beams as a CARMEN log" in done.stderr
    before, after = stillmap_folder.read(room), read(tmp_path / name)
    np.testing.assert_array_equal(before.hit, after.hit)
    np.testing.assert_allclose(after.points[after.hit], before.points[before.hit], atol=6e-5)
    nothing_left(name)


@pytest.mark.parametrize("name", ["a.bag", "a.db3", "a.mcap", "a"])
def test_to_a_bag(call, room, tmp_path, nothing_left, name):
    to = ["--to", "ros2"] if name == "a" else []
    done = call("convert", room, "-o", tmp_path / name, "--quiet", *to)
    assert (done.returncode, done.stderr) == (0, "")
    assert topics_of(tmp_path / name) == {"/scan": 40, "/odom": 40, "/tf": 40, "/tf_static": 1}
    nothing_left(name)


def test_to_a_recording_folder(call, room, tmp_path):
    for source, name in ((room, "a.log"), (tmp_path / "a.log", "b")):
        assert call("convert", source, "-o", tmp_path / name).returncode == 0
    before, after = read(tmp_path / "a.log"), stillmap_folder.read(tmp_path / "b")
    for name in ("stamp_ns", "points", "hit", "T_odom_base", "T_base_sensor"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    assert after.source == before.source


def test_refusals(call, room, tmp_path, nothing_left):
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "file").write_text("")
    (tmp_path / "a.log").write_text("")
    out = tmp_path / "b.log"
    refused(call("convert", tmp_path / "none", "-o", out), "none: does not exist")
    refused(call("convert", room, "-o", tmp_path / "a.abc"), "'.abc'", ".mcap")
    refused(call("convert", room, "-o", tmp_path / "a.log"), "is there already", "--overwrite")
    refused(call("convert", tmp_path / "none", "-o", tmp_path / "a.obj"), "none: does not exist")
    (tmp_path / "afile").write_text("")
    for name in ("afile/a.log", "afile/b/a"):
        said = f"{tmp_path / name}: cannot be written: "
        refused(call("convert", room, "-o", tmp_path / name), said)
    refused(call("convert", room, "-o", room, "--overwrite"), "is the recording itself")
    refused(call("convert", room, "-o", room.parent, "--overwrite"), "holds the recording")
    refused(call("convert", room, "-o", "/dev/null", "--to", "carmen", "--overwrite"), "no regular")
    refused(call("convert", room, "-o", out, "--input", room), "--input is for results")
    refused(call("convert", room, "-o", tmp_path / "a.parquet"), "'.parquet'")
    for to in ("stillmap", "ros2"):  # only folders of the same kind are overwritten
        done = call("convert", room, "-o", precious, "--overwrite", "--to", to)
        refused(done, "holds other things")
    nothing_left("precious", "a.log", "afile")
    assert (precious / "file").exists()


@pytest.mark.parametrize("name", ["conv/c.log", "conv/more/c.bag", "conv/c"])
def test_parent_folders_are_created(call, room, mapped, tmp_path, nothing_left, name):
    output = tmp_path / name
    refused(call("convert", room, "-o", output, "--only", "static"), "--only is for results")
    refused(call("convert", mapped, "-o", output, "--min-range", 1), "no flags")
    nothing_left()
    assert call("convert", room, "-o", output).returncode == 0
    assert read(output).n_scans == 40
    nothing_left("conv")


@pytest.mark.parametrize("name", ["a.bag", "a.db3", "a.mcap", "a"])
def test_result_as_bag(call, mapped, tmp_path, nothing_left, name):
    to = ["--to", "ros2"] if name == "a" else []
    done = call("convert", mapped, "-o", tmp_path / name, *to)
    assert done.returncode == 0, done.stderr
    found = topics_of(tmp_path / name)
    moved = found.pop("/objects")
    assert moved > 0
    assert found == {
        **dict.fromkeys(("/scan", "/scan_dynamic", "/tf", "/odom"), 40),
        **dict.fromkeys(("/map", "/trajectory", "/tf_static"), 1),
    }
    nothing_left(name)


def test_result_as_table(call, room, mapped, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    assert call("convert", mapped, "-o", tmp_path / "a.parquet").returncode == 0
    table = parquet.read_table(tmp_path / "a.parquet")
    columns = {name: table[name].to_numpy() for name in table.column_names}
    recording, (_, T) = stillmap_folder.read(room), read_tum(mapped / "trajectory.tum")
    poses = T[:, [0, 1, 3]][:, :, [0, 1, 3]]
    scan = np.repeat(np.arange(40), 120)
    np.testing.assert_array_equal(columns["scan"], scan)
    np.testing.assert_array_equal(columns["beam"], np.tile(np.arange(120), 40))
    np.testing.assert_array_equal(columns["stamp_ns"], recording.stamp_ns[scan])
    np.testing.assert_array_equal(columns["hit"], recording.hit)
    np.testing.assert_array_equal(columns["p_static"], np.load(mapped / "beams/p_static.npy"))
    np.testing.assert_allclose(
        columns["range"], np.linalg.norm(recording.points, axis=1), rtol=1e-6
    )
    ends = recording.end_points(np.arange(4800), poses)
    np.testing.assert_allclose(np.stack([columns["x"], columns["y"]], -1), ends, atol=1e-5)
    refused(call("convert", mapped, "-o", tmp_path / "a.parquet"), "is there already")
    assert call("convert", mapped, "-o", tmp_path / "b.parquet").returncode == 0
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()


def test_formats_that_results_do_not_have(call, room, mapped, tmp_path, nothing_left):
    refused(call("convert", mapped, "-o", tmp_path / "a.log"), "as a CARMEN log", "filter")
    refused(call("convert", mapped, "-o", tmp_path / "a"), "as a recording folder")
    refused(call("convert", mapped, "-o", tmp_path / "a.abc"), "'.abc'", ".mcap", ".e57", ".pcd")
    refused(call("convert", mapped, "-o", tmp_path / "a.mcap", "--min-range", 1), "no flags")
    for output in (mapped, mapped.parent, room):
        done = call("convert", mapped, "-o", output, "--overwrite", "--to", "ros2")
        refused(done, "recording")
    nothing_left()


@pytest.mark.parametrize(
    ("name", "module", "package"),
    [
        ("a.las", "laspy", "laspy"),
        ("a.laz", "lazrs", "lazrs"),
        ("a.e57", "pye57.libe57", "pye57"),
    ],
)
def test_clouds_need_their_libraries(
    call, mapped, tmp_path, monkeypatch, nothing_left, name, module, package
):
    pytest.importorskip("laspy")  # it looks for lazrs once, and remembers what it found
    monkeypatch.setitem(sys.modules, module, None)
    done = call("convert", mapped, "-o", tmp_path / name)
    refused(done, f"needs {package} to be written", install_command("io"))
    nothing_left()


def test_moved_recording(call, room, mapped, tmp_path):
    result = tmp_path / "result"
    shutil.copytree(mapped, result)
    record = json.loads((result / "run.json").read_text())
    record["input"]["path"] = str(tmp_path / "gone")
    (result / "run.json").write_text(json.dumps(record))
    refused(call("convert", result, "-o", tmp_path / "a.mcap"), "gone: does not exist", "--input")
    assert call("convert", result, "-o", tmp_path / "a.mcap", "--input", room).returncode == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "objects.json: is not JSON"),
        ("[{}]", "objects.json: is damaged"),
        ("[" * 100_000, "objects.json: is not JSON"),
        ('[{"id": 1, "size": [1, 1], "track": {"stamp_ns": [], "x": [], "y": [], "vx": [], '
         '"vy": []}}]', "unequal length"),
        ('[{"id": 1, "size": [1, NaN], "track": {"stamp_ns": [1], "x": [0], "y": [0], '
         '"vx": [0], "vy": [0]}}]', "is not JSON"),
    ],
)  # fmt: skip
def test_damaged_objects(call, mapped, tmp_path, text, words):
    result = tmp_path / "result"
    shutil.copytree(mapped, result)
    (result / "objects/objects.json").write_text(text)
    refused(call("convert", result, "-o", tmp_path / "a.mcap"), words)
    shutil.rmtree(result / "objects")  # --set objects.enabled=false
    assert call("convert", result, "-o", tmp_path / "a.mcap").returncode == 0
