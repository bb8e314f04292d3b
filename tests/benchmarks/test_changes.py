"""What the benchmark of changes counts with: stays and beams of a world, scores of a result."""

from types import SimpleNamespace

import numpy as np
import pytest
from cases import Case
from change_scores import list_true_changes
from changes import COLUMNS, _of_things, _scored, beams_of, scores_of, stays_of
from common import Run
from tables import means_and_worst

from stillmap.core.se2 import inverse, matrix
from stillmap.sim import Simulation, scene_by_name, simulate

SHORT = {"robot": {"scans": 1000}}


@pytest.fixture(scope="module")
def street() -> Simulation:
    """Until all cars that leave or come have done so, and most of that was seen."""
    return simulate(scene_by_name("street-moved", SHORT), 0)


@pytest.mark.slow
def test_stays_are_those_of_the_things(street: Simulation) -> None:
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


def perfect(simulation: Simulation, state: str) -> SimpleNamespace:
    """A result at true poses, with a map made by hand and changes that are all right."""
    truth, beams, stays = simulation.truth, beams_of(simulation), stays_of(simulation)
    resolution, low = 0.05, beams.end.min(axis=0) - 1.0
    shape = np.ceil((beams.end.max(axis=0) + 1.0 - low) / resolution).astype(int)[::-1]
    p = np.full(shape, 0.1, np.float32)
    for stay in stays:
        if stay.contains(simulation.recording.stamp_ns[-1:])[0] == (state == "last"):
            cells = np.floor((beams.end[beams.hits_on(stay)] - low) / resolution).astype(int)
            p[cells[:, 1], cells[:, 0]] = 0.9
    occupancy = SimpleNamespace(
        p_occupied=p, origin=(float(low[0]), float(low[1]), 0.0), resolution=resolution
    )
    found = [
        SimpleNamespace(
            kind="came" if c.appeared else "left", appeared=c.appeared, stamp_ns=c.observed_ns,
            x=float(c.stay.center[0]), y=float(c.stay.center[1]),
        )
        for c in list_true_changes(stays, beams) if c.observed_ns is not None
    ]  # fmt: skip
    options = SimpleNamespace(output=SimpleNamespace(map_state="last"))
    mapping = SimpleNamespace(changes=found)
    return SimpleNamespace(
        poses=truth.T_world_base, map=occupancy, mapping=mapping, options=options
    )


def test_what_is_right_scores_full_marks(street: Simulation) -> None:
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


def test_doors_and_what_comes_and_goes_are_no_things() -> None:
    hinge, width = (3.0, -1.0), 0.9
    scene = SimpleNamespace(leaves=[SimpleNamespace(hinge=hinge, width=width)])
    T_world_map = matrix(10.0, -5.0, np.pi / 2)

    def change(kind: str, off: float) -> SimpleNamespace:
        """So far from the hinge, in the frame of the map."""
        x, y, _ = inverse(T_world_map) @ [hinge[0] + 0.6 * off, hinge[1] - 0.8 * off, 1.0]
        return SimpleNamespace(kind=kind, x=float(x), y=float(y))

    on_leaf = [change(kind, off) for kind in ("came", "left") for off in (0.0, 0.5, 1.09)]
    apart = [change(kind, off) for kind in ("came", "left") for off in (1.11, 4.0)]
    often = [change("comes and goes", off) for off in (0.5, 4.0)]
    simulation = SimpleNamespace(scene=scene)
    assert _of_things([*often, *on_leaf, *apart], simulation, T_world_map) == apart
    assert _of_things(often, simulation, T_world_map) == []
    scene.leaves = []
    assert _of_things([*on_leaf, *apart], simulation, T_world_map) == [*on_leaf, *apart]


@pytest.mark.slow
def test_a_run_is_scored_and_shown() -> None:
    case = Case("street", "moved", "street-moved", SHORT)
    scores = _scored(Run(case, 0, "stillmap", ("em.max_iterations=1",), True))
    assert 0.0 <= scores["old_occupied"] <= 1.0
    assert scores["ate"] == pytest.approx(0.0, abs=1e-9)
    text = means_and_worst(
        [{"case": "a", **scores}, {"case": "b", **scores, "median_error": float("nan")}], COLUMNS
    )
    assert text.count("\n") == 4
    assert "nan" not in text
