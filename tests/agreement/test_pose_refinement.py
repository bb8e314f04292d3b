"""Pose refinement: kernel against the twin, by hand, and wrong arguments."""

import numpy as np
import pytest
from reference import pose_refinement
from rooms import ROOM, drive

from stillmap import _core
from stillmap.core import se2
from stillmap.slam import scan_hits, scan_matching

OWN_POSE_STD = np.array([0.02, 0.02])


@pytest.fixture(scope="module")
def watched():
    """A recording of a room with a person, disturbed poses, and labels."""
    route, laser = ((-3.0, -2.0), (3.0, -2.0), (3.0, 0.5)), {"beams": 90, "max_range": 6.0}
    found = drive(3, ROOM, route, 1, laser=laser, robot={"scans": 30})
    rng = np.random.default_rng(0)
    shift = se2.matrix(*(0.02 * rng.standard_normal((3, 30))))
    e = rng.choice([0.0, 0.3, 1.0], found.recording.n_beams, p=[0.1, 0.2, 0.7])
    return found.recording, se2.normalize(found.truth.T_world_base @ shift), e.astype(np.float32)


def arguments(recording, e, poses, has_step=None, kept=None):
    """Of the twin, but for the grid."""
    increments = np.concatenate([se2.inverse(poses[:-1]) @ poses[1:], np.eye(3)[None]])
    shift = se2.matrix(*(0.01 * np.random.default_rng(1).standard_normal((3, len(poses)))))
    steps = np.ones(len(poses), bool) if has_step is None else has_step
    steps[-1] = False
    std = np.random.default_rng(2).uniform(0.01, 0.05, (len(poses), 2))
    kept = np.arange(len(poses)) % 3 == 0 if kept is None else kept
    return recording, e, kept, poses, increments @ shift, std, steps, OWN_POSE_STD


def grid_of(recording, e, kept, poses):
    grid = _core.OccupancyGrid2D(0.05, scan_hits.FREE_SPACE_MARGIN)
    for t in np.flatnonzero(kept):
        scan_hits.add_scan(grid, recording, e, t, poses[t])
    return grid


def kernel(grid, recording, e, kept, poses, increments, std, has_step, own_pose_std, changed=()):
    """All scans but the first one in one call."""
    first = recording.offset[1]
    given = {
        "points": recording.points[first:],
        "hit": recording.hit[first:],
        "e": e[first:],
        "offset": recording.offset[1:] - first,
        "T_base_sensor": recording.T_base_sensor[recording.sensor[1:]],
        "is_in_map": kept[1:],
        "poses": np.concatenate([poses, poses[-1:]]),
        "increments": increments,
        "step_std": std,
        "has_step": has_step,
        "own_pose_std": own_pose_std,
    }
    return _core.refine_scans(
        grid, **{**given, **dict(changed)}, **scan_matching.refinement_options(grid)
    )


@pytest.mark.parametrize("steps", ["all", "some", "none"])
def test_agrees_with_the_twin(watched, steps):
    recording, poses, e = watched
    rng = np.random.default_rng(4)
    share = {"all": 1.0, "some": 0.5, "none": 0.0}[steps]
    given = arguments(recording, e, poses, rng.random(len(poses)) < share)
    one, other = (grid_of(recording, e, given[2], poses) for _ in range(2))
    found, expected = kernel(one, *given), pose_refinement.refine_scans(other, *given)
    assert np.abs(expected[0] - poses).max() > 0.01
    np.testing.assert_allclose(found[0], expected[0][1:], atol=1e-6)
    np.testing.assert_allclose(found[1], expected[1][1:], rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(found[2], expected[2][1:], atol=1e-5)
    for ours, theirs in zip(one.dense(), other.dense(), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-3)


def test_in_parts_it_is_the_same(watched):
    recording, poses, e = watched
    given = list(arguments(recording, e, poses))
    whole = kernel(grid_of(recording, e, given[2], poses), *given)
    grid, so_far = grid_of(recording, e, given[2], poses), poses.copy()
    for first, last in ((1, 12), (12, 30)):
        beams = slice(int(recording.offset[first]), int(recording.offset[last]))
        around = np.concatenate([so_far, so_far[-1:]])[first - 1 : last + 1]
        part = {
            "points": recording.points[beams],
            "hit": recording.hit[beams],
            "e": e[beams],
            "offset": recording.offset[first : last + 1] - beams.start,
            "T_base_sensor": recording.T_base_sensor[recording.sensor[first:last]],
            "is_in_map": given[2][first:last],
            "poses": around,
            "increments": given[4][first - 1 : last],
            "step_std": given[5][first - 1 : last],
            "has_step": given[6][first - 1 : last],
        }
        so_far[first:last] = kernel(grid, *given, changed=part)[0]
    np.testing.assert_array_equal(so_far[1:], whole[0])
