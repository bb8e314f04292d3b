import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from stillmap.cli.main import main
from stillmap.core import se2
from stillmap.io import stillmap_folder
from stillmap.io.trajectory import write_tum
from stillmap.results.map_server import write_map_npz
from stillmap.results.reader import Grid
from stillmap.results.writer import write_labels
from stillmap.sim import Scene, scene_by_name, simulate, write_simulation
from stillmap.sim.options import CrowdOptions, LaserOptions, RobotOptions
from stillmap.sim.walls import box

RESOLUTION = 0.1
SIZE = 140  # cells: the room from anywhere in it
TRAJECTORY = "0 0 0 0\n1 1 0 0\n2 2 0 0.5\n"
RELATIONS = "0 1 1.25 0 0 0 0 0\n1 2 1 0 0 0 0 0.5\n"


@pytest.fixture(scope="module")
def simulated(tmp_path_factory) -> Path:
    """A small room with two people, 60 scans."""
    scene = Scene(
        "room",
        walls=tuple(box(0, 0, 8, 6)),
        route=((-2.5, -1.5), (2.5, -1.5), (2.5, 1.5)),
        crowd=CrowdOptions(people=2),
        laser=LaserOptions(beams=120, range_noise=0.005),
        robot=RobotOptions(scans=60),
    )
    path = tmp_path_factory.mktemp("simulated") / "room"
    write_simulation(simulate(scene, np.random.default_rng(0)), path)
    return path


@pytest.fixture
def result(simulated, tmp_path) -> Path:
    """A result as good as the truth allows, in the frame of the first pose."""
    out = tmp_path / "result"
    out.mkdir()
    recording = stillmap_folder.read(simulated)
    truth = simulated / "truth"
    T_world_base, static = np.load(truth / "T_world_base.npy"), np.load(truth / "static.npy")
    T_map_base = se2.inverse(T_world_base[0]) @ T_world_base
    write_tum(out / "trajectory.tum", recording.stamp_ns, T_map_base)
    p_static = np.where(recording.hit, np.where(static, 0.98, 0.03), 0.8).astype(np.float32)
    p_static[~np.isfinite(recording.points).all(1)] = np.nan
    write_labels(out / "beams", recording, p_static)
    write_map(out, recording, T_map_base, static & recording.hit)
    return out


def write_map(out: Path, recording, T_map_base, beams) -> None:
    """Cells that these beams hit are occupied, all others free."""
    scan = np.repeat(np.arange(recording.n_scans), np.diff(recording.offset))[beams]
    T = recording.T_map_sensor(T_map_base)[scan]
    ends = np.einsum("nij,nj->ni", T[:, :2, :2], recording.points[beams]) + T[:, :2, 2]
    p = np.full((SIZE, SIZE), 0.02, np.float32)
    grid = Grid(p, (-SIZE / 2 * RESOLUTION, -SIZE / 2 * RESOLUTION, 0.0), RESOLUTION)
    p[tuple(grid.cells(ends).T)] = 0.95
    occupancy = SimpleNamespace(
        p_occupied=p, alpha=p, beta=p, origin=grid.origin, resolution=RESOLUTION
    )
    write_map_npz(out / "map.npz", occupancy)


def scores(capsys, *args: object) -> dict:
    assert main(["eval", *(str(arg) for arg in args), "--json"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return json.loads(out)


def refusal(capsys, *args: object) -> str:
    assert main(["eval", *(str(arg) for arg in args)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    return err


@pytest.fixture
def texts(tmp_path) -> SimpleNamespace:
    paths = SimpleNamespace(trajectory=tmp_path / "t.txt", relations=tmp_path / "r.relations")
    paths.trajectory.write_text(TRAJECTORY)
    paths.relations.write_text(RELATIONS)
    return paths


def test_relations(capsys, texts):
    s = scores(capsys, "relations", texts.trajectory, texts.relations)
    assert (s["relations"], s["used"]) == (2, 2)
    assert s["translation"]["mean"] == pytest.approx(0.125)
    assert s["rotation"]["max"] == pytest.approx(0.0)
    assert main(["eval", "relations", str(texts.trajectory), str(texts.relations)]) == 0
    assert "mean 0.125, std 0.176777" in capsys.readouterr().out


def test_relations_with_odometry(capsys, texts, tmp_path):
    texts.trajectory.write_text("0 0 0 0\n")
    log = tmp_path / "log"
    log.write_text("".join(f"ODOM {k} 0 0 0 0 0 {k} host 0\n" for k in range(3)))
    s = scores(capsys, "relations", texts.trajectory, texts.relations, "--odom", log)
    assert (s["used"], s["stamps_by_odometry"]) == (2, 2)
    s = scores(capsys, "relations", texts.trajectory, texts.relations, "--max-dt", "1.5")
    assert s["used"] == 1


def test_no_usable_relation(capsys, texts):
    texts.relations.write_text("50 60 1 0 0 0 0 0\n")
    said = refusal(capsys, "relations", texts.trajectory, texts.relations)
    assert str(texts.relations) in said
    assert "--odom" in said


@pytest.mark.parametrize("flags", [["--max-dt", "-1"], ["--max-dt", "nan"], ["--delta", "0"]])
def test_impossible_numbers_are_refused(capsys, texts, flags):
    said = refusal(capsys, "trajectory", texts.trajectory, texts.trajectory, *flags)
    assert flags[0] in said


def test_trajectory(capsys, simulated, result):
    reference = simulated / "truth" / "trajectory.tum"
    s = scores(capsys, "trajectory", result / "trajectory.tum", reference)
    assert (s["poses"], s["dimension"]) == (60, 2)
    assert s["ate"]["max"] < 1e-6
    assert s["rpe"]["pairs"] > 10
    assert s["rpe"]["rotation"]["max"] < 1e-5
    frames = ("--delta", "3", "--delta-unit", "frames")
    s = scores(capsys, "trajectory", result / "trajectory.tum", reference, *frames)
    assert s["rpe"]["pairs"] == 57
    assert main(["eval", "trajectory", str(reference), str(reference)]) == 0
    out = capsys.readouterr().out
    assert "ate                     rmse " in out
    assert "units                   m, deg\n" in out


def test_trajectories_without_a_common_time(capsys, texts, tmp_path):
    other = tmp_path / "later.txt"
    other.write_text("100 0 0 0\n")
    said = refusal(capsys, "trajectory", texts.trajectory, other)
    assert "no two stamps" in said
    assert str(texts.trajectory) in said


def test_labels(capsys, simulated, result):
    recording = stillmap_folder.read(simulated)
    s = scores(capsys, "labels", result, simulated)
    static = np.load(simulated / "truth/static.npy")
    assert s["hits"] == recording.hit.sum()
    assert s["dynamic"] == (recording.hit & ~static).sum() > 50
    assert (s["average_precision"], s["f1"]) == (1.0, 1.0)
    assert s["brier"] < 0.001
    assert s == scores(capsys, "labels", result, simulated / "truth")
    assert main(["eval", "labels", str(result), str(simulated)]) == 0
    assert "f1                      1" in capsys.readouterr().out


def test_map(capsys, simulated, result):
    s = scores(capsys, "map", result, simulated)
    assert s["ghost_cells"] == 0
    assert s["walls_kept"] == 1.0
    assert s["reference_wall_cells"] > 100
    first = se2.parameters(np.load(simulated / "truth/T_world_base.npy")[0])
    assert s["T_world_map"] == pytest.approx(first.tolist(), abs=1e-6)
    assert main(["eval", "map", str(result), str(simulated)]) == 0
    assert "walls_kept              1" in capsys.readouterr().out


@pytest.fixture
def raw(simulated, tmp_path) -> Path:
    """A result with people in its map, whose frame is the world's."""
    out, recording = tmp_path / "raw", stillmap_folder.read(simulated)
    T_world_base = np.load(simulated / "truth/T_world_base.npy")
    out.mkdir()
    write_tum(out / "trajectory.tum", recording.stamp_ns, T_world_base)
    write_map(out, recording, T_world_base, recording.hit)
    return out


def test_map_with_people_against_reference_map(capsys, simulated, result, raw):
    s = scores(capsys, "map", raw, simulated)
    assert s["ghosts_per_100_m2"] > 10
    assert s["walls_kept"] == 1.0
    s = scores(capsys, "map", result, simulated, "--reference", raw)
    assert s["walls_kept"] > 0.97
    again = ("--reference", raw, "--reference-truth", simulated)
    assert scores(capsys, "map", result, simulated, *again) == s


def test_things_brought_in_are_not_ghosts(capsys, simulated, raw, tmp_path):
    there = shutil.copytree(simulated, tmp_path / "there")
    everywhere = [(-4.0, y, 4.0, y) for y in np.arange(-3, 3, 0.05)]
    np.save(there / "truth/lasting.npy", np.array(everywhere))
    assert scores(capsys, "map", raw, simulated)["ghost_cells"] > 10
    assert scores(capsys, "map", raw, there)["ghost_cells"] == 0
    (there / "truth/lasting.npy").unlink()  # as where there are none
    assert scores(capsys, "map", raw, there)["ghost_cells"] > 10


def broken(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:60])


@pytest.mark.parametrize("damage", [Path.unlink, broken, lambda path: path.write_bytes(b"")])
@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("labels", "result/beams/p_static.npy"),
        ("labels", "result/beams/hit.npy"),
        ("labels", "result/beams/offset.npy"),
        ("labels", "result/beams/stamp_ns.npy"),
        ("labels", "simulated/truth/static.npy"),
        ("labels", "simulated/hit.npy"),
        ("map", "result/map.npz"),
        ("map", "result/trajectory.tum"),
        ("map", "simulated/truth/walls.npy"),
        ("map", "simulated/truth/T_world_base.npy"),
    ],
)
def test_missing_and_damaged_files_are_named(
    capsys, simulated, result, tmp_path, kind, name, damage
):
    shutil.copytree(simulated, tmp_path / "simulated")
    damage(tmp_path / name)
    said = refusal(capsys, kind, result, tmp_path / "simulated")
    assert str(tmp_path / name) in said


@pytest.mark.parametrize(
    ("name", "at", "said"), [("p_static", 17, "beam 17"), ("stamp_ns", 5, "scan 5 differs")]
)
def test_labels_that_cannot_be_or_are_of_another_recording(
    capsys, simulated, result, name, at, said
):
    path = result / f"beams/{name}.npy"
    array = np.load(path)
    array[at] += 1
    np.save(path, array)
    assert said in refusal(capsys, "labels", result, simulated)


def test_missing_folders_are_named(capsys, result, simulated, tmp_path):
    nothere = tmp_path / "nothere"
    for kind in ("labels", "map"):
        for pair in ((nothere, simulated), (result, nothere)):
            assert f"{nothere}: does not exist" in refusal(capsys, kind, *pair)
    said = refusal(capsys, "map", result, simulated, "--reference", nothere)
    assert f"{nothere}: does not exist" in said


def test_map_of_another_recording_is_refused(capsys, result, simulated, tmp_path):
    other = shutil.copytree(simulated, tmp_path / "other")
    np.save(other / "stamp_ns.npy", np.load(other / "stamp_ns.npy") + 10**12)
    said = refusal(capsys, "map", result, other)
    assert f"{result}: is not of the recording in {other}" in said
    assert "--max-dt" not in said


@pytest.fixture(scope="module")
def rig(tmp_path_factory) -> Path:
    """What two lasers recorded, as many beams each at the same times."""
    changes = {"rig": {"tilts": True}, "robot": {"scans": 20, "scan_rate": 37.5}}
    path = tmp_path_factory.mktemp("rig") / "sim"
    write_simulation(simulate(scene_by_name("hall", changes), 2), path)
    for name in ("stamp_ns", "offset"):
        of = [np.load(path / part / f"{name}.npy") for part in ("horizontal", "tilting")]
        np.testing.assert_array_equal(*of)
    return path


@pytest.mark.parametrize("part", ["horizontal", "tilting"])
def test_rig_labels_select_the_truth(capsys, rig, tmp_path, part):
    out, recording = tmp_path / "out", stillmap_folder.read(rig / part)
    out.mkdir()
    p_static = np.where(np.load(rig / part / "truth/static.npy"), 0.9, 0.2).astype(np.float32)
    write_labels(out / "beams", recording, p_static)
    found = scores(capsys, "labels", out, rig)
    assert found == scores(capsys, "labels", out, rig / part)
    assert found["brier"] < 0.05
    assert found["hits"] == np.count_nonzero(recording.hit)
