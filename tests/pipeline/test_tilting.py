"""`stillmap map --tilting` from end to end on a small simulated rig."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from stillmap.cli.main import main
from stillmap.io import read, stillmap_folder
from stillmap.io.trajectory import read_tum
from stillmap.prepare.options import ReadOptions
from stillmap.prepare.time_window import TimeWindow, select_time
from stillmap.sim import load_truth, scene_by_name, simulate, write_simulation

QUICK = ("--quiet", "--threads", "1", "--set", "em.max_iterations=1")
QUICK += ("--set", "mesh.enabled=false")


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """Folder of a hall with people for 12 s, seen by two lasers."""
    path = tmp_path_factory.mktemp("rig") / "sim"
    changes = {
        "rig": {"tilts": True, "period": 2.0},
        "laser": {"beams": 91, "sweep_time": 0.02, "max_range": 12.0},
        "robot": {"scans": 300, "scan_rate": 25.0},
        "crowd": {"people": 25},
    }
    write_simulation(simulate(scene_by_name("hall", changes), 5), path)
    return path


def command(*words):
    return main([str(word) for word in (*words, *QUICK)])


@pytest.fixture(scope="module")
def mapped(rig, tmp_path_factory):
    """What comes of it."""
    out = tmp_path_factory.mktemp("mapped") / "out"
    assert command("map", rig / "horizontal", "--tilting", rig / "tilting", "-o", out) == 0
    return out


@pytest.mark.slow
def test_labels_are_those_of_the_truth(rig, mapped):
    p_static = np.load(mapped / "tilting/beams/p_static.npy")
    hit, truth = np.load(rig / "tilting/hit.npy"), load_truth(rig / "tilting")
    known = hit & ~np.isnan(p_static)
    removed = p_static[known] < 0.5
    static = truth.static[known]
    assert (~static).sum() > 100
    assert removed[~static].mean() > 0.85
    assert removed[static].mean() < 0.01


def test_the_files_belong_together(rig, mapped):
    counts = {name: _vertices(mapped / f"{name}.ply") for name in ("static", "dynamic")}
    record = json.loads((mapped / "run.json").read_text())["tilting"]
    assert record["input"]["path"] == str(rig / "tilting")
    assert counts["static"] + counts["dynamic"] == record["counts"]["hits"]
    assert counts["dynamic"] == record["dynamic"] > 0
    # the last scan goes on after the last pose is known
    T, n = 300, 91
    assert record["counts"]["left_out"] == record["counts"]["unusable"] > 0
    assert record["counts"]["left_out"] < n
    assert len(np.load(mapped / "tilting/beams/stamp_ns.npy")) == T
    assert np.load(mapped / "tilting/beams/offset.npy")[-1] == T * n
    stamps, poses = read_tum(mapped / "tilting/trajectory.tum")
    np.testing.assert_array_equal(stamps, read_tum(mapped / "trajectory.tum")[0])
    np.testing.assert_allclose(poses, read_tum(mapped / "trajectory.tum")[1], atol=1e-6)


def test_the_planar_laser_may_come_in_parts(rig, mapped, tmp_path):
    whole, parts = read(rig / "horizontal"), []
    seconds = (whole.stamp_ns - whole.stamp_ns[0]) / 1e9
    for number, (first, last) in enumerate(((0, 149), (150, 299))):
        window = TimeWindow(ReadOptions(start=seconds[first] or None, end=seconds[last]))
        parts.append(tmp_path / str(number))
        stillmap_folder.write(select_time(whole, window), parts[-1])
    words = ("map", *parts[::-1], "--tilting", rig / "tilting", "-o", tmp_path / "out")
    assert command(*words) == 0
    for name in ("beams/p_static.npy", "tilting/beams/p_static.npy", "static.ply"):
        assert (tmp_path / "out" / name).read_bytes() == (mapped / name).read_bytes()


@pytest.mark.parametrize("only", ["static", "dynamic", None])
def test_the_cloud_of_the_second_laser_can_be_converted(mapped, tmp_path, only):
    laspy, path = pytest.importorskip("laspy"), tmp_path / "a.laz"
    more = () if only is None else ("--only", only)
    assert main(["convert", str(mapped), "-o", str(path), "--quiet", *more]) == 0
    parts = [only] if only else ["static", "dynamic"]
    known = np.concatenate([trimesh.load(mapped / f"{part}.ply").vertices for part in parts])
    found = laspy.read(path)
    np.testing.assert_allclose(found.xyz, known, atol=0.6e-4)
    assert (found["p_static"] < 0.5).any() == (only != "static")


def test_report_counts_dynamic_returns(mapped):
    text = (mapped / "report.html").read_text()
    section = text.split(">Second laser</h2>")[1].split("</section>")[0]
    record = json.loads((mapped / "run.json").read_text())["tilting"]
    share = 100 * record["dynamic"] / record["counts"]["hits"]
    for said in (
        f"{record['dynamic']:,} of these ({share:.1f} %) are dynamic",
        f"with {record['boxes']:,} boxes",
        f"{record['objects']:,} of the tracked objects",
        f"{record['counts']['left_out']:,} beams were left out",
        "with what the second laser itself saw occupied and free",
    ):
        assert said in section
    assert section.count("<img") == 2


def test_objects_have_a_height_and_points(mapped):
    objects = json.loads((mapped / "tilting/objects/objects.json").read_text())
    assert objects
    flat = {one["id"] for one in json.loads((mapped / "objects/objects.json").read_text())}
    for one in objects:
        assert one["id"] in flat
        assert 0.05 < one["size"][2] < 2.1
        assert len(one["track"]["z"]) == len(one["track"]["x"])
        assert _vertices(mapped / f"tilting/objects/{one['id']:04d}.ply") == one["beams"] >= 3
    assert max(one["size"][2] for one in objects) > 1.2


def test_planar_result_is_unchanged(rig, mapped, tmp_path):
    assert command("map", rig / "horizontal", "-o", tmp_path / "out") == 0
    for name in ("map.pgm", "beams/p_static.npy", "objects/objects.json", "trajectory.tum"):
        assert (tmp_path / "out" / name).read_bytes() == (mapped / name).read_bytes()
    assert not (tmp_path / "out/tilting").exists()


def refused(capsys, *words):
    """The one line with which the command refuses."""
    assert command(*words) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    return err


def test_no_overlap_in_time_is_refused(rig, tmp_path, capsys):
    tilting = stillmap_folder.read(rig / "tilting")
    later = replace(tilting, stamp_ns=tilting.stamp_ns + 3_600_000_000_000)
    stillmap_folder.write(later, tmp_path / "later")
    words = ("map", rig / "horizontal", "--tilting", tmp_path / "later", "-o", tmp_path / "out")
    line = refused(capsys, *words)
    assert "not recorded at the same time" in line
    assert str(tmp_path / "later") in line
    assert not (tmp_path / "out").exists()


def test_wrong_dimensions_are_refused(rig, tmp_path, capsys):
    flat, tilting, out = rig / "horizontal", rig / "tilting", tmp_path / "out"
    assert "is in 2D" in refused(capsys, "map", flat, "--tilting", flat, "-o", out)
    said = refused(capsys, "map", tilting, "--tilting", tilting, "-o", out)
    assert "the planar laser decides" in said


def test_wrong_options_and_folders_are_refused(rig, tmp_path, capsys):
    words = ("map", rig / "horizontal", "--tilting", rig / "tilting", "-o")
    assert "holds" in refused(capsys, *words, rig, "--overwrite")
    nowhere = ("map", rig / "horizontal", "--tilting", tmp_path / "nowhere", "-o", tmp_path / "out")
    assert "nowhere" in refused(capsys, *nowhere)


def _vertices(path):
    head = path.read_bytes().split(b"end_header")[0].decode()
    return int(head.split("element vertex ")[1].split("\n")[0])
