"""Changes of places in 3D: right ones are found, wrong dates and places are not."""

from functools import partial

import numpy as np
import pytest
from place_changes import FoundChange, score_changes
from place_truth import load_session_truth
from place_voxels import VOXEL, Voxels, collect_voxels

from stillmap.sim import scene_by_name
from stillmap.sim.sessions import draw_piece, plan_sessions, write_sessions

# whole simulations are scored
pytestmark = pytest.mark.slow

SWEEPS = {"lidar": {"channels": 12, "columns": 120}, "robot": {"scans": 12}}
SESSIONS = [0, 1, 2]


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    """Three sessions of a piece of a street."""
    folder = tmp_path_factory.mktemp("sessions") / "days"
    routes = [partial(draw_piece, begin=begin) for begin in (40.0, 40.0, 42.0)]
    street = scene_by_name("street-empty", SWEEPS)
    write_sessions([plan_sessions(street, 3, 3, routes=routes, has_odd_sensor=False)], folder)
    return load_session_truth(folder)


@pytest.fixture(scope="module")
def cells(truth):
    return collect_voxels(truth, SESSIONS, np.empty((0, 3)))


def true_changes(truth, cells):
    found = []
    for change in truth.changes:
        left, came = (cells.draw_object(truth, change.object, k) for k in change.between)
        found.append(FoundChange(change.kind, *change.between, came & ~left, left & ~came))
    return found


def test_right_none_and_spurious_changes(truth, cells):
    right = true_changes(truth, cells)
    elsewhere = [one._replace(came=one.left & False, left=cells.fixed) for one in right]
    perfect, nothing, wrong = (
        score_changes(found, "cells", cells, truth, SESSIONS) for found in (right, [], elsewhere)
    )
    assert perfect.cells > 30
    assert perfect.f1 > 0.98
    assert perfect.events_found == perfect.events > 1
    assert perfect.dates_right == 1.0
    assert (nothing.recall, nothing.events_found) == (0.0, 0)
    assert wrong.recall < 0.2
    assert wrong.spurious > 0


def test_voxels_are_found_by_their_points_and_have_26_neighbours():
    steps = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3), axis=-1).reshape(-1, 3)
    centre = np.array([-3.1, 5.3, -0.1])
    voxels = Voxels(centre + VOXEL * steps)
    assert len(voxels.key) == 27
    middle = np.zeros(27, bool)
    middle[voxels.find(centre[None])] = True
    assert voxels.widen(middle).all()
    np.testing.assert_allclose(voxels.centres()[middle][0], centre, atol=0.5 * VOXEL)
    assert voxels.find(centre[None] + 1.0) == [-1]
