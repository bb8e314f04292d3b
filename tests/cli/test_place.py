"""A place in the commands for results: `filter`, `convert`, `eval`."""

import json
import os
import re
import shutil

import numpy as np
import pytest
from flat import files_of
from refusals import refused

import stillmap
from stillmap.io import read
from stillmap.io.writers import write


def blanked(place, name):
    labels = place / "sessions" / name / "beams"
    p_static = np.load(labels / "p_static.npy")
    return np.load(labels / "hit.npy") & (p_static < 0.5)


def test_every_session_is_filtered(call, flat_place, flat_days, tmp_path):
    out = tmp_path / "clean"
    done = call("filter", flat_place, "-o", out, "--json")
    assert done.returncode == 0
    for name in ("map1", "map2"):
        assert re.search(rf"^stillmap: {name}: \d+ beams blanked", done.stderr, re.MULTILINE)
    said = json.loads(done.stdout)
    assert said["output"] == str(out)
    assert json.loads((out / "filtered.json").read_text()) == said["sessions"]
    assert sorted(os.listdir(out)) == ["filtered.json", "map1", "map2"]
    for one in said["sessions"]:
        day, gone = flat_days / one["name"].replace("map", "day"), blanked(flat_place, one["name"])
        assert one["input"] == str(day)
        assert one["blanked"] == gone.sum() > 0
        before, after = read(day), read(out / one["file"])
        np.testing.assert_array_equal(after.hit, before.hit & ~gone)
        np.testing.assert_array_equal(after.points, before.points)
    # a label of the place: the chest came later, so nothing of the first day was blanked for it
    refused(call("filter", flat_place, "-o", out), "already holds something")
    assert call("filter", flat_place, "-o", out, "--overwrite", "--quiet").returncode == 0
    refused(call("filter", flat_place, "-o", tmp_path), "already holds something")
    refused(call("filter", flat_place, "-o", tmp_path, "--overwrite"), "filtered.json is replaced")


def test_one_session_is_shown_with_its_place(call, flat_place):
    home = flat_place / "sessions" / "map2"
    done = call("view", home)
    refused(done, f"{home}: is a session of a place", f"stillmap view {flat_place} shows all")


def test_the_ending_is_that_of_the_format(call, flat_place, flat_days, tmp_path):
    done = call("filter", flat_place, "-o", tmp_path / "bags", "--to", "mcap", "--quiet")
    assert (done.returncode, done.stderr) == (0, "")
    assert sorted(os.listdir(tmp_path / "bags")) == ["filtered.json", "map1.mcap", "map2.mcap"]
    assert read(tmp_path / "bags" / "map1.mcap").n_scans == 100
    copy = tmp_path / "place"
    shutil.copytree(flat_place, copy)
    for number, name in ((1, "monday.log"), (2, "tuesday.clf")):  # as if they had been logs
        write(stillmap.read(flat_days / f"day{number}"), tmp_path / name)
        recording = read(tmp_path / name)
        home = copy / "sessions" / f"map{number}"
        record = json.loads((home / "run.json").read_text())
        record["input"]["path"] = str(tmp_path / name)
        (home / "run.json").write_text(json.dumps(record))
        for array in ("stamp_ns", "offset", "hit"):
            np.save(home / "beams" / f"{array}.npy", getattr(recording, array))
    done = call("filter", copy, "-o", tmp_path / "logs", "--quiet")
    assert (done.returncode, done.stderr) == (0, "")
    assert sorted(os.listdir(tmp_path / "logs")) == ["filtered.json", "map1.log", "map2.clf"]
    assert call("filter", copy, "-o", tmp_path / "c", "--to", "carmen", "--quiet").returncode == 0
    assert sorted(os.listdir(tmp_path / "c")) == ["filtered.json", "map1.log", "map2.clf"]


def test_all_sessions_or_none(call, flat_place, tmp_path, nothing_left):
    copy, out = tmp_path / "copy", tmp_path / "clean"
    shutil.copytree(flat_place, copy)
    path = copy / "sessions" / "map2" / "run.json"
    record = json.loads(path.read_text())
    record["input"]["path"] = str(tmp_path / "day2")
    path.write_text(json.dumps(record))
    refused(
        call("filter", copy, "-o", out), "day2: does not exist", "sessions/map2 -o FILE --input"
    )
    shutil.copy(flat_place / "sessions" / "map2" / "run.json", path)
    (copy / "sessions" / "map2" / "beams" / "p_static.npy").write_bytes(b"")
    refused(call("filter", copy, "-o", out, "--quiet"), "p_static.npy: is damaged")
    refused(call("filter", copy, "-o", out, "--input", tmp_path), "has several recordings")
    refused(call("filter", copy, "-o", copy, "--overwrite"), "is the recording itself")
    nothing_left("copy")


def test_maps_and_masks(call, flat_place, tmp_path):
    out = tmp_path / "maps"
    done = call("convert", flat_place, "-o", out, "--to", "nav2")
    assert done.returncode == 0, done.stderr
    assert (out / "map.pgm").read_bytes() == (flat_place / "map.pgm").read_bytes()
    masks = tmp_path / "masks"
    assert call("convert", flat_place, "-o", masks, "--keepout-crossings", "1").returncode == 0
    assert (masks / "keepout.yaml").exists()
    home = flat_place / "sessions" / "map1"
    assert call("convert", home, "-o", tmp_path / "x", "--keepout-crossings", "1").returncode == 0
    assert files_of(tmp_path / "x") == files_of(masks)  # the map, too, is that of the place


def test_what_a_place_does_not_become(call, flat_place, tmp_path, nothing_left):
    for name in ("place.mcap", "beams.parquet", "place.las", "folder"):
        done = call("convert", flat_place, "-o", tmp_path / name)
        refused(done, "a place of several recordings", "sessions/NAME -o FILE")
    nothing_left()


def test_a_session_is_converted_in_the_frame_of_the_place(call, flat_place, tmp_path):
    home = flat_place / "sessions" / "map2"
    assert call("convert", home, "-o", tmp_path / "s.mcap", "--quiet").returncode == 0
    table = pytest.importorskip("pyarrow.parquet")
    assert call("convert", home, "-o", tmp_path / "s.parquet", "--quiet").returncode == 0
    beams = table.read_table(tmp_path / "s.parquet").to_pydict()
    place = stillmap.load(flat_place)
    np.testing.assert_array_equal(
        np.float32(beams["p_static"]), place.p_static[np.load(home / "beams/offset.npy")[-1] :]
    )
    T = place.sessions[1].T_place_session
    own = stillmap.load(flat_place.parent / "place" / "sessions" / "map2")
    assert np.linalg.norm(own.poses[0, :2, 2] - T[:2, 2]) < 0.1
    hit = np.array(beams["hit"])
    x, y = np.array(beams["x"])[hit], np.array(beams["y"])[hit]
    _, high = place.map.origin[:2], np.array(place.map.p_occupied.shape)[::-1]
    high = np.array(place.map.origin[:2]) + place.map.resolution * high
    assert x.max() < high[0] + 0.1
    assert y.max() < high[1] + 0.1


def test_a_cloud_of_a_place_in_3d(call, flat_place, tmp_path):
    """Of the points that the place itself has: no recording is read."""
    from stillmap.io.point_cloud.ply import make_header

    copy = tmp_path / "place"
    shutil.copytree(flat_place, copy)
    record = json.loads((copy / "run.json").read_text())
    (copy / "run.json").write_text(json.dumps({**record, "dimension": 3}))
    fields = [(name, "<f4") for name in ("x", "y", "z", "p_static")]
    for part, p in (("static", 0.9), ("dynamic", 0.1)):
        points = np.array([(1.0, 2.0, 3.0, p)] * 3, fields)
        (copy / f"{part}.ply").write_bytes(make_header(fields, 3) + points.tobytes())
    done = call("convert", copy, "-o", tmp_path / "a.xyz")
    assert done.returncode == 0, done.stderr
    assert "6 points" in done.stderr
    assert call("convert", copy, "-o", tmp_path / "b.xyz", "--only", "static").returncode == 0
    assert (tmp_path / "b.xyz").read_text().count("\n") == 4
    refused(call("convert", copy, "-o", tmp_path / "c.mcap"), "or a cloud (.las")


def test_scores(call, flat_place, flat_days):
    home, day = flat_place / "sessions" / "map2", flat_days / "day2"
    refused(call("eval", "labels", flat_place, day), "several recordings", "sessions/NAME")
    done = call("eval", "labels", home, day, "--json")
    assert json.loads(done.stdout)["f1"] > 0.8
    for result in (flat_place, home):
        done = call("eval", "map", result, day, "--json")
        assert json.loads(done.stdout)["walls_kept"] > 0.95
