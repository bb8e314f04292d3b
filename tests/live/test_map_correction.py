"""A correction that is applied in parts counts no evidence twice, and none is lost."""

import numpy as np

import stillmap
from stillmap.core import se2
from stillmap.em.options import EmOptions
from stillmap.live.causal_labels import CausalLabels, take_over
from stillmap.live.loop_closer import Correction
from stillmap.live.map_frame import MapCorrection
from stillmap.live.scan import Observation, to_beams

BEAMS, BINS, MEANWHILE = 720, 6, 12  # time bins before the correction, and while it goes on
# by whole cells: none is seen between two of them
MOTION = se2.matrix(2.0, -1.0, 0.0)


def look(k):
    """A scan of a room with walls around, and somebody who walks by."""
    angles = np.linspace(-np.pi, np.pi, BEAMS, endpoint=False) + 1e-3
    ranges = 9.0 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    ranges[np.abs(angles - 0.2 * k) < 0.1] = 4.0
    beams = to_beams(stillmap.Scan(k * 500_000_000, ranges, angles))
    T = se2.matrix(0.3 * k + 0.013, 0.007, 0.0)
    return Observation(beams, T, np.full(BEAMS, 0.1, np.float32))


def make_labels(scans):
    labels = CausalLabels(2, 0.05, EmOptions())
    for scan in scans:
        labels.add(scan, scan.T)
    return labels


def correct_in_parts(labels, scans):
    """The labels after a correction in parts while scans arrive, a step with each."""
    here = np.eye(3)[None]
    correction = MapCorrection(
        Correction(MOTION, MOTION[None], []), labels, here, here, np.array([0])
    )
    scans, is_done, blocks = iter(scans), False, []
    while not is_done:
        scan = next(scans, None)
        if scan is not None:
            labels.add(scan, scan.T)
            correction.note_labelled(scan)
        is_done = correction.step(labels)
        blocks.append(correction._block)
    correction.finish(labels)
    return labels, blocks


def states(labels):
    """P(static and occupied) by cell."""
    known = labels.known_cells()
    return dict(zip(map(tuple, known.cells.tolist()), known.p_occupied.tolist(), strict=True))


def test_evidence_is_counted_once():
    before = [look(k) for k in range(BINS)]
    meanwhile = [look(k) for k in range(BINS, BINS + MEANWHILE)]
    found, blocks = correct_in_parts(make_labels(before), meanwhile)
    # scans were added to blocks that were copied before them, and to others
    assert sum(one < blocks[-1] for one in blocks) > 3
    expected = make_labels([*before, *meanwhile])
    moved = expected.filter.sibling()
    take_over(moved, expected.filter, MOTION[None], 0, expected.filter.block_count)
    expected.filter = moved
    ours, theirs = states(found), states(expected)
    both = np.array([(ours[cell], theirs[cell]) for cell in ours.keys() & theirs.keys()])
    assert len(both) > 0.95 * len(ours.keys() | theirs.keys())
    assert len(both) > 1000
    off = np.abs(both[:, 0] - both[:, 1])
    assert np.mean(off > 0.02) < 0.02
