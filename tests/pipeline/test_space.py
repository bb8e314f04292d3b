"""3D recordings from start to end: labels, poses, clouds, plan and objects against the truth."""

import dataclasses
import json

import numpy as np
import pytest
import trimesh
import yaml
from choices import options
from marks import slow_params
from PIL import Image
from recordings import of_one_sensor

import stillmap
from stillmap.cli.main import main
from stillmap.io.trajectory import read_tum
from stillmap.pipeline.options import Options
from stillmap.results.report.page import render_report
from stillmap.sim import scene_by_name, simulate, write_simulation


@pytest.fixture(scope="module")
def street():
    """A street with cars and people, 40 sweeps of 32 channels, taken all at once."""
    lidar = {"channels": 32, "columns": 600, "sweep": False}
    scene = scene_by_name("street", {"lidar": lidar, "robot": {"scans": 40}})
    return simulate(scene, 3)


@pytest.fixture(scope="module")
def mapped(street):
    return stillmap.build(street.recording, poses=street.truth.T_world_base)


def near(street):
    """Hits between 2.5 and 40 m."""
    distance = np.linalg.norm(street.recording.points, axis=1)
    return street.recording.hit & (distance > 2.5) & (distance < 40.0)


@pytest.mark.slow
def test_what_moves_is_told_from_what_stands(street, mapped):
    dynamic, near_ones = mapped.p_static < 0.5, near(street)
    static = street.truth.static
    assert (~static & near_ones).sum() > 1000
    assert dynamic[near_ones & ~static].mean() > 0.75
    assert dynamic[near_ones & static].mean() < 0.005


@pytest.mark.slow
def test_ground_contact_goes_with_the_mover_above(street, mapped, monkeypatch):
    monkeypatch.setattr("stillmap.em.spatial_coupling.ObstacleSurfels.min_end_height", 100.0)
    other = stillmap.build(street.recording, poses=street.truth.T_world_base)
    mine = near(street) & ~street.truth.static
    found = [np.mean(one.p_static[mine] < 0.5) for one in (mapped, other)]
    static = near(street) & street.truth.static
    lost = np.mean(mapped.p_static[static] < 0.5) - np.mean(other.p_static[static] < 0.5)
    assert lost < 5e-4
    assert found[0] > found[1] + 0.002


def share_of_far_ground_called_dynamic(street, result):
    """Of static hits on the ground from 15 m on, where the rings of the lidar lie apart."""
    recording = street.recording
    beams = np.flatnonzero(recording.hit & street.truth.static)
    ends = recording.end_points(beams, street.truth.T_world_base)
    far = np.linalg.norm(recording.points[beams], axis=1) > 15.0
    on_ground = far & (ends[:, 2] < np.quantile(ends[:, 2], 0.01) + 0.05)
    assert on_ground.sum() > 1000
    return np.mean(result.p_static[beams[on_ground]] < 0.5)


@pytest.mark.slow
def test_single_rings_on_far_ground_are_static(street, mapped, monkeypatch):
    monkeypatch.setattr("stillmap.em.spatial_coupling.label_far_ground", lambda *same: same)
    other = stillmap.build(street.recording, poses=street.truth.T_world_base)
    now, before = (share_of_far_ground_called_dynamic(street, one) for one in (mapped, other))
    assert now < 0.001
    assert before > 5.0 * now
    mine = near(street) & ~street.truth.static
    lost = np.mean(other.p_static[mine] < 0.5) - np.mean(mapped.p_static[mine] < 0.5)
    assert lost < 0.002


def test_given_poses_take_one_e_step(mapped):
    assert len(mapped.iterations) == 1
    assert mapped.converged


@pytest.mark.slow
def test_estimated_poses_are_those_of_the_truth(street):
    result = stillmap.build(street.recording)
    truth = np.linalg.inv(street.truth.T_world_base[0]) @ street.truth.T_world_base
    apart = np.linalg.norm(result.poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert apart.max() < 0.1
    dynamic, near_ones = result.p_static < 0.5, near(street)
    assert dynamic[near_ones & ~street.truth.static].mean() > 0.75
    assert dynamic[near_ones & street.truth.static].mean() < 0.005


def test_the_plan_is_free_where_the_robot_drove(street, mapped):
    x, y, _ = mapped.map.origin
    way = street.truth.T_world_base[:, :2, 3]
    column, row = np.floor((way - [x, y]) / mapped.map.resolution).astype(int).T
    assert (mapped.map.p_occupied[row, column] < 0.196).all()
    assert (mapped.map.p_occupied > 0.65).sum() > 500


@pytest.mark.slow
def test_what_was_learned_is_of_all_classes(street, mapped):
    """Also of what came to stay or left: as the labels are."""
    recording, voxel = street.recording, mapped.options.slam.voxel_size
    hits = np.flatnonzero(recording.hit)
    ends = recording.end_points(hits, street.truth.T_world_base)
    _, cell = np.unique(np.floor(ends / voxel), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    static = np.bincount(cell, street.truth.static[hits]) / np.bincount(cell)
    assert mapped.learned["p_static"] == pytest.approx((static > 0.5).mean(), abs=0.1)
    assert 0.0 < mapped.learned["changing"] < 0.2
    missed = ~recording.hit & np.isfinite(mapped.p_static)
    assert mapped.p_static[missed] == pytest.approx(mapped.learned["p_static"])
    report = render_report(mapped)
    percent = f"{100 * mapped.learned['p_static']:.1f} %"
    assert f"{percent} of the cells in which beams ended are static" in report
    assert "put down or taken away" in " ".join(report.split())
    unasked = {k: v for k, v in mapped.learned.items() if k != "changing"}
    estimate = mapped.estimate.with_labels(learned=unasked)
    mapping = dataclasses.replace(mapped.mapping, estimate=estimate)
    assert "put down" not in render_report(dataclasses.replace(mapped, mapping=mapping))


@pytest.mark.slow
@pytest.mark.parametrize("threads", [2, *slow_params(3)])
def test_any_number_of_threads_gives_the_same_bytes(street, mapped, threads):
    other = stillmap.build(
        street.recording, Options(threads=threads), poses=street.truth.T_world_base
    )
    np.testing.assert_array_equal(other.p_static, mapped.p_static)
    np.testing.assert_array_equal(other.map.p_occupied, mapped.map.p_occupied)


def test_cars_are_objects_with_heights(street, mapped):
    kinds = np.array(street.truth.scene["mover_kinds"])
    large = [one for one in mapped.objects if len(one.beams) > 500]
    cars = [one for one in large if (kinds[street.truth.mover[one.beams]] == "car").mean() > 0.8]
    assert cars
    for one in cars:
        assert len(one.size) == 3
        assert 0.5 < one.size[2] < 2.5
        assert one.z.shape == (len(one.scan),)
        assert 0.2 < np.median(one.z) < 1.6


def test_the_files_hold_what_was_found(street, mapped, tmp_path):
    mapped.save(tmp_path / "out")
    out = tmp_path / "out"
    hits = int(street.recording.hit.sum())
    clouds = {name: trimesh.load(out / f"{name}.ply") for name in ("static", "dynamic")}
    assert sum(len(cloud.vertices) for cloud in clouds.values()) == hits
    moving = int((mapped.p_static[street.recording.hit] < 0.5).sum())
    assert len(clouds["dynamic"].vertices) == moving
    stamps, poses = read_tum(out / "trajectory.tum")
    np.testing.assert_array_equal(stamps, street.recording.stamp_ns)
    np.testing.assert_allclose(poses, street.truth.T_world_base, atol=1e-8)
    assert np.array_equal(np.load(out / "beams/p_static.npy"), mapped.p_static, equal_nan=True)
    described = yaml.safe_load((out / "map.yaml").read_text())
    with Image.open(out / described["image"]) as picture:
        assert picture.size == mapped.map.p_occupied.shape[::-1]
    objects = json.loads((out / "objects/objects.json").read_text())
    assert all({"x", "y", "z", "vx", "vy"} <= set(one["track"]) for one in objects)
    run = json.loads((out / "run.json").read_text())
    assert run["options"]["slam"]["voxel_size"] == run["options"]["slam"]["resolution"] == 0.15
    assert "<html" in (out / "report.html").read_text()


def test_labels_in_space_are_scored_and_plans_are_not(street, mapped, tmp_path, capsys):
    write_simulation(street, tmp_path / "sim")
    mapped.save(tmp_path / "out")
    words = [str(tmp_path / "out"), str(tmp_path / "sim")]
    assert main(["eval", "labels", *words, "--json"]) == 0
    scores = json.loads(capsys.readouterr().out)
    moving = street.recording.hit & ~street.truth.static
    assert scores["dynamic"] == moving.sum()
    assert scores["recall"] == pytest.approx((mapped.p_static[moving] < 0.5).mean(), abs=1e-6)
    assert main(["eval", "map", *words]) == 2
    assert "is not a planar recording" in capsys.readouterr().err


@pytest.mark.slow
def test_the_printed_method_runs_in_3d():
    lidar = {"channels": 16, "columns": 300, "sweep": False}
    scene = scene_by_name("street", {"lidar": lidar, "robot": {"scans": 10}})
    street = simulate(scene, 3)
    chosen = options(estimator="paper", max_iterations=2)
    result = stillmap.build(street.recording, chosen, poses=street.truth.T_world_base)
    assert len(result.iterations) == 2
    assert np.isfinite(result.p_static[street.recording.hit]).all()


@pytest.mark.parametrize("how", ["all at the sensor", "nothing came back", "all unusable", "none"])
@pytest.mark.parametrize("given", [True, False])
def test_sweeps_that_say_nothing_are_mapped_all_the_same(how, given, tmp_path):
    n = 0 if how == "none" else 50
    points = np.zeros((5 * n, 3), np.float32)
    points[:, 0] = {"nothing came back": 30.0, "all unusable": np.nan}.get(how, 0.0)
    hit = np.full(5 * n, how == "all at the sensor")
    recording = of_one_sensor(np.arange(5) * 10**8, np.arange(6) * n, points, hit)
    poses = np.tile(np.eye(4), (5, 1, 1)) if given else None
    result = stillmap.build(recording, poses=poses)
    assert np.isfinite(result.poses).all()
    assert any("no odometry" in one for one in result.warnings) == (not given)
    result.save(tmp_path / "out")
    assert (tmp_path / "out/report.html").exists()
