"""A known map in a projection: the robot is found, and all that is told is in the map's frame."""

import json

import numpy as np
import pytest
from live_runs import push_all

import stillmap
from stillmap.io.trajectory import read_tum
from stillmap.live.mapper import LiveMapper
from stillmap.results.reader import read_grid
from stillmap.sim import scene_by_name, simulate

UTM = np.array([477_123.4567, 5_312_345.678])
SCANS = 60


@pytest.fixture(scope="module")
def hall(tmp_path_factory):
    """A recording of a hall, and its map near the origin and in a projection."""
    folder = tmp_path_factory.mktemp("far")
    made = simulate(scene_by_name("hall", {"crowd": {"people": 0}, "robot": {"scans": 250}}), 2)
    for name, by in (("near", np.zeros(2)), ("far", UTM)):
        poses = made.truth.T_world_base.copy()
        poses[:, :2, 2] += by - made.truth.T_world_base[0, :2, 2]
        stillmap.build(made.recording, {"threads": 1, "em.max_iterations": 1}, poses=poses).save(
            folder / name
        )
    return made.recording, folder


def drive(recording, place, mode="localise"):
    mapper = LiveMapper({"threads": 1}, place=place, mode=mode)
    return mapper, push_all(mapper, recording, SCANS)


# m: rounding moves single scans, as their cost has steps where end points leave observed space
# and in a map that grows the scans after them
@pytest.mark.parametrize(
    ("mode", "rounding"), [("localise", 2e-3), pytest.param("extend", 4e-3, marks=pytest.mark.slow)]
)
def test_what_is_told_is_in_the_frame_of_the_map(hall, tmp_path, mode, rounding):
    recording, folder = hall
    near, told = drive(recording, folder / "near", mode)
    far, told_far = drive(recording, folder / "far", mode)
    with near, far:
        found = ["lost" not in one.doubts for one in told_far]
        assert found[-1]
        assert found == ["lost" not in one.doubts for one in told]
        for one, other, is_found in zip(told, told_far, found, strict=True):
            by = UTM * is_found
            np.testing.assert_allclose(other.pose[:2, 2] - by, one.pose[:2, 2], atol=rounding)
            np.testing.assert_allclose(
                other.T_map_odom[:2, 2] - by, one.T_map_odom[:2, 2], atol=0.1
            )
        np.testing.assert_allclose(far.poses[-1, :2, 2] - UTM, near.poses[-1, :2, 2], atol=2e-3)
        np.testing.assert_allclose(far.path[-1, :2, 2] - UTM, near.path[-1, :2, 2], atol=2e-3)
        np.testing.assert_allclose(
            np.array(far.map.origin[:2]) - UTM, near.map.origin[:2], atol=0.2
        )
        low = far.cells.cells.min(axis=0) * far.resolution - UTM
        np.testing.assert_allclose(low, near.cells.cells.min(axis=0) * near.resolution, atol=0.2)
        changed = [one.first_cell for update in told_far[-5:] for one in update.changes]
        assert np.abs(np.array(changed) * far.resolution - UTM).max() < 100.0
        far.save(tmp_path / "out")
    for name in ("trajectory.tum", "live/trajectory.tum"):
        written = read_tum(tmp_path / "out" / name)[1]
        assert np.abs(written[-1, :2, 3] - told_far[-1].pose[:2, 2]).max() < 0.05
    grid = read_grid(tmp_path / "out")
    assert np.abs(np.array(grid.origin[:2]) - UTM).max() < 100.0
    assert json.loads((tmp_path / "out" / "run.json").read_text())["local_origin"]
