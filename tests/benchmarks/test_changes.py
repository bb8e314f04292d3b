"""What the benchmark of changes counts with: stays and beams of a world, scores of a result."""

from types import SimpleNamespace

import numpy as np
import pytest
from change_scores import list_true_changes
from changes import COLUMNS, beams_of, scores_of, stays_of

from stillmap.sim import scene_by_name, simulate

# whole simulations are scored
pytestmark = pytest.mark.slow

SHORT = {"robot": {"scans": 1000}}


@pytest.fixture(scope="module")
def street():
    """Until all cars that leave or come have done so, and most of that was seen."""
    return simulate(scene_by_name("street-moved", SHORT), 0)


def test_stays_are_those_of_the_things(street):
    stays = stays_of(street)
    kinds = street.truth.scene["mover_kinds"]
    assert {kinds[stay.mover] for stay in stays} == {"thing"}
    assert len(stays) == 5 + 1 + 2  # five cars leave, one of them for another place; two come
    beams = beams_of(street)
    for stay in stays:
        ends = beams.end[beams.hits_on(stay)]
        assert np.hypot(*(ends - stay.center).T).max(initial=0.0) < 2.7
    early = simulate(scene_by_name("street-moved", {"robot": {"scans": 520}}), 0)
    # two have driven off within 52 s; the others are walls, or not there yet
    changes = list_true_changes(stays_of(early), beams_of(early))
    assert [c.appeared for c in changes] == [False, False]
    assert {c.appeared for c in list_true_changes(stays, beams)} == {False, True}


def perfect(simulation, state):
    """A result at true poses, with a map made by hand and changes that are all right."""
    truth, beams, stays = simulation.truth, beams_of(simulation), stays_of(simulation)
    resolution, low = 0.05, beams.end.min(axis=0) - 1.0
    shape = np.ceil((beams.end.max(axis=0) + 1.0 - low) / resolution).astype(int)[::-1]
    p = np.full(shape, 0.1, np.float32)
    for stay in stays:
        if stay.contains(simulation.recording.stamp_ns[-1:])[0] == (state == "last"):
            cells = np.floor((beams.end[beams.hits_on(stay)] - low) / resolution).astype(int)
            p[cells[:, 1], cells[:, 0]] = 0.9
    found = []
    for c in list_true_changes(stays, beams):
        if c.observed_ns is not None:
            x, y = c.stay.center.tolist()
            kind = {"kind": "came" if c.appeared else "left", "appeared": c.appeared}
            found.append(SimpleNamespace(**kind, stamp_ns=c.observed_ns, x=x, y=y))
    return SimpleNamespace(
        poses=truth.T_world_base,
        map=SimpleNamespace(p_occupied=p, origin=(*low.tolist(), 0.0), resolution=resolution),
        mapping=SimpleNamespace(changes=found),
        options=SimpleNamespace(output=SimpleNamespace(map_state="last")),
    )


def test_what_is_right_scores_full_marks(street):
    scores = scores_of(perfect(street, "last"), street)
    assert {column.key for column in COLUMNS} == set(scores)
    assert (scores["new_kept"], scores["old_occupied"]) == (1.0, 0.0)
    assert scores["new_cells"] > 20
    assert scores["old_cells"] > 50
    assert scores["seen"] == scores["found"] >= 3
    assert scores["missed"] == scores["false"] == scores["largest_error"] == 0
    assert scores["things"] == scores["one_state"] == scores["right"] >= 3
    first = scores_of(perfect(street, "first"), street)
    assert (first["one_state"], first["right"]) == (scores["things"], 0)
    assert (first["new_kept"], first["old_occupied"]) == (0.0, 1.0)
