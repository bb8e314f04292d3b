"""In the cells that are listed labels and map are those of the last E-step, to the bit."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from synthetic_histories import RESOLUTION, block, course, recording

from stillmap import em
from stillmap.core import chunks, se2
from stillmap.core.recording import Recording
from stillmap.em.observations import build_surfel_map
from stillmap.mapping import Change, relabel_changes
from stillmap.mapping.changed_objects import pool_states
from stillmap.mapping.labelled_recording import LabelledRecording

SCANS, BEAMS = 60, 20
# around the origin, and with cells in which no beam ended
LISTED = [block(-2, -3, 4, 5), block(3, 1, 2, 2), block(40, 40, 2, 2)]


def change(cells):
    return Change("came", 0.0, 0.0, (0.1, 0.1), cells, RESOLUTION, 1, 2, 2, 1)


CHANGES = [change(cells) for cells in LISTED]


@dataclass(frozen=True)
class Known:
    """A recording, the cells in which its beams end, what the loop said of them, and histories."""

    seen: Recording
    poses: np.ndarray
    ends: np.ndarray  # (M, 2) cells
    p_static: np.ndarray
    occupied: em.CellProbabilities
    histories: em.CellHistories

    def p_in_map(self, state):
        return self.histories.p_in_map(state, pool_states(self.histories, CHANGES, state))

    def relabelled(self, changes=CHANGES, state="last", threads=1, **other):
        said = {"occupied": self.occupied, "histories": self.histories} | other
        known = LabelledRecording(self.seen, self.poses, self.p_static, RESOLUTION, threads)
        return relabel_changes(known, **said, changes=changes, state=state)


@pytest.fixture(scope="module")
def known():
    rng = np.random.default_rng(5)
    M = SCANS * BEAMS
    ends = rng.integers(-6, 7, (M, 2))
    poses = se2.matrix(rng.normal(size=SCANS), rng.normal(size=SCANS), rng.uniform(-3, 3, SCANS))
    # well within its cell: single precision moves none across an edge
    there = np.column_stack([(ends + rng.uniform(0.2, 0.8, (M, 2))) * RESOLUTION, np.ones(M)])
    T = se2.inverse(poses).repeat(BEAMS, axis=0)
    points = np.einsum("nij,nj->ni", T, there)[:, :2].astype(np.float32)
    hit, usable = rng.random(M) < 0.8, rng.random(M) < 0.95
    points[~usable] = np.nan
    seen = replace(recording(range(SCANS), BEAMS), points=points, hit=hit & usable)
    surface = build_surfel_map(seen, poses, RESOLUTION)
    cells = surface.surfels()[0]
    loop = rng.random(M).astype(np.float32)
    loop[~usable] = np.nan
    of_cells, thing, share, covered = rng.random((4, len(cells))).astype(np.float32)
    return Known(
        seen,
        poses,
        ends,
        loop,
        em.CellProbabilities(cells, of_cells, 0.2),
        replace(
            course(cells, True, (10, 12)),
            p_object=thing,
            occupied_share=share,
            p_in_cell=covered,
            surfel_map=surface,
        ),
    )


def listed(cells):
    """(K,) whether they are among those of the changes."""
    those = {tuple(cell) for one in LISTED for cell in one.tolist()}
    return np.array([tuple(cell) in those for cell in cells.tolist()])


@pytest.mark.parametrize("state", ["last", "majority"])
def test_labels_of_beams_that_end_there_are_what_is_shown(known, state):
    p_static, _ = known.relabelled(state=state)
    there = listed(known.ends) & known.seen.hit
    assert 50 < there.sum() < 400
    of_cell = dict(
        zip(map(tuple, known.histories.cells.tolist()), known.p_in_map(state), strict=True)
    )
    shown = np.array([of_cell.get(tuple(cell), np.nan) for cell in known.ends.tolist()], np.float32)
    assert p_static.dtype == np.float32
    np.testing.assert_array_equal(p_static, np.where(there, shown, known.p_static))
    assert np.isnan(p_static).sum() > 20


@pytest.mark.parametrize("state", ["last", "majority"])
def test_the_map_says_there_what_is_shown_as_far_as_it_covers_the_cell(known, state):
    _, occupied = known.relabelled(state=state)
    there = listed(known.occupied.cells)
    assert 15 < there.sum() < 30
    shown = known.p_in_map(state) * known.histories.p_in_cell
    assert occupied.p_occupied.dtype == np.float32
    np.testing.assert_array_equal(
        occupied.p_occupied, np.where(there, shown, known.occupied.p_occupied)
    )
    np.testing.assert_array_equal(occupied.cells, known.occupied.cells)
    assert occupied.free_prior == known.occupied.free_prior


@pytest.mark.parametrize(("beams", "threads"), [(50, 3), (10**6, 2)])
def test_pieces_and_threads_change_no_bit(known, monkeypatch, beams, threads):
    one, of_one = known.relabelled()
    monkeypatch.setattr(chunks, "CHUNK_BEAMS", beams)
    other, of_other = known.relabelled(threads=threads)
    assert one.tobytes() == other.tobytes()
    assert of_one.p_occupied.tobytes() == of_other.p_occupied.tobytes()


def test_where_nothing_is_listed_nothing_is_touched(known):
    p_static, occupied = known.relabelled([])
    assert p_static is known.p_static
    assert occupied is known.occupied


@pytest.mark.parametrize("wrong", ["fewer", "others"])
def test_cells_that_do_not_match_are_refused(known, wrong):
    cells, p = known.occupied.cells, known.occupied.p_occupied
    other = {
        "fewer": em.CellProbabilities(cells[1:], p[1:], 0.2),
        "others": em.CellProbabilities(cells + 1, p, 0.2),
    }
    with pytest.raises(ValueError, match="occupied: expected the cells"):
        known.relabelled(occupied=other[wrong])
