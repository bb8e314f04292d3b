"""Counts (10) of a part of the map."""

import numpy as np
import pytest

from stillmap import _core, em
from stillmap.sim import CrowdOptions, LaserOptions, RobotOptions, Scene, simulate
from stillmap.sim.walls import box

RESOLUTION = 0.1


@pytest.fixture(scope="module")
def seen():
    """A recording with hits, beams without a return and unusable ones, true poses and labels."""
    scene = Scene(
        "room",
        walls=(*box(0, 0, 9, 7), *box(1.5, 1.6, 0.9, 0.6)),
        route=((-2.5, -1.5), (2.5, -1.5), (2.5, 1.5)),
        crowd=CrowdOptions(people=2),
        laser=LaserOptions(beams=60, max_range=5.0),
        robot=RobotOptions(scans=40),
    )
    found = simulate(scene, 1)
    rng = np.random.default_rng(0)
    e = rng.random(found.recording.n_beams).astype(np.float32)
    unusable = rng.random(len(e)) < 0.05
    unusable[:60] = True  # a whole scan
    found.recording.points[unusable] = np.nan
    found.recording.hit[unusable] = False
    return found.recording, found.truth.T_world_base, e


@pytest.fixture(scope="module")
def whole(seen):
    recording, poses, e = seen
    grid = _core.OccupancyGrid2D(RESOLUTION)
    em.add_recording(grid, recording, poses, e)
    return grid


@pytest.mark.parametrize("window", [(-1.0, -1.0, 1.5, 0.5), (2.0, 1.0, 9.0, 9.0), (20, 20, 21, 21)])
def test_counts_in_a_window_are_those_of_the_whole_map(seen, whole, window):
    recording, poses, e = seen
    boxes = em.beam_boxes(recording, poses)
    part = em.count_in_window(recording, poses, e, boxes, window, RESOLUTION)
    x0, y0, x1, y1 = (round(metres / RESOLUTION) for metres in window)
    cells = [x0, y0], (y1 - y0, x1 - x0)
    for ours, theirs in zip(part.dense(*cells), whole.dense(*cells), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert whole.dense(*cells)[2].any() == (window[0] < 10)


def test_every_kth_scan_counts_where_many_are_near(seen):
    recording, poses, e = seen
    boxes, window = em.beam_boxes(recording, poses), (-3.0, -2.0, 3.0, 2.0)
    T = recording.n_scans
    part = em.count_in_window(recording, poses, e, boxes, window, RESOLUTION, max_scans=15)
    near = [t for t in range(T) if (boxes[t, :2] <= window[2:]).all()
            and (boxes[t, 2:] >= window[:2]).all()]  # fmt: skip
    every = -(-len(near) // 15)
    assert every > 1
    expected = _core.OccupancyGrid2D(RESOLUTION)
    for t in near[::every]:
        beams, T_map_sensor = recording.beams_of(t), recording.T_map_sensor(poses)[t : t + 1]
        offset = np.array([0, beams.stop - beams.start])
        points, hit = recording.points[beams], recording.hit[beams]
        _core.add_beams(expected, points, hit, e[beams], offset, T_map_sensor)
    cells = [-30, -20], (40, 60)
    for ours, theirs in zip(part.dense(*cells), expected.dense(*cells), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_boxes_hold_all_beams(seen, whole):
    recording, poses, _ = seen
    boxes = em.beam_boxes(recording, poses)
    first_cell, (height, width) = whole.bounding_box()
    low, high = (np.floor(each / RESOLUTION) for each in (boxes[:, :2].min(0), boxes[:, 2:].max(0)))
    # a beam does not count in the cell of its end unless it hit something there
    assert ((first_cell - 1 <= low) & (low <= first_cell)).all()
    last_cell = first_cell + np.array([width, height]) - 1
    assert ((last_cell <= high) & (high <= last_cell + 1)).all()
    # of a scan without a usable beam, where the sensor is
    sensor = recording.T_map_sensor(poses)[0, :2, 2]
    np.testing.assert_allclose(boxes[0], [*sensor, *sensor])
