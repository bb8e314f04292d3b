"""Corrections of the pose graph: of poses and cells, also where the robot was carried; in parts, no
evidence is counted twice and none is lost."""

import numpy as np
import pytest

import stillmap
from stillmap.core import se2
from stillmap.em.options import EmOptions
from stillmap.live.causal_labels import CausalLabels, take_over
from stillmap.live.local_map import LocalMap, MappedScan
from stillmap.live.loop_closer import Correction
from stillmap.live.map_frame import MapCorrection, MapFrame
from stillmap.live.registration import Registration
from stillmap.live.scan import Observation, to_beams

CARRIED = 7  # spaced scans before the robot was carried, 1 m apart; as many scans after each
MOTION = se2.matrix(0.0, 3.0, 0.0)  # of what was mapped since


class Closer:
    """Moves what was mapped since the robot was carried."""

    def __init__(self):
        self.poses = []
        self.found = None

    def add(self, scan, _explained, _drift):
        self.poses.append(scan.T_map_base)

    def poll(self):
        found, self.found = self.found, None
        return found

    def stop(self):
        pass


class Odometry:
    local_map = LocalMap(0.05)

    def correct(self, local_map, motion):
        pass


@pytest.fixture
def run():
    """A frame and labels after a correction; poses and anchors of all scans. Each scan sees a spot
    2 m ahead of it."""
    closer, labels = Closer(), CausalLabels(2, 0.05, EmOptions())
    frame = MapFrame(2, labels, Odometry(), closer, in_background=False)
    poses, anchors = [], []
    for k in range(4 * 2 * CARRIED):
        if k == 4 * CARRIED + 2:  # not at a spaced scan
            frame.begin_anew(k)
        T = se2.matrix(0.25 * k, 0.0, 0.0)
        beams = to_beams(stillmap.Scan(k * 10**9, np.full(3, 2.0), np.full(3, 1e-3)))
        poses.append(T)
        anchors.append(frame.last)
        observation = Observation(beams, T, np.full(3, 0.1, np.float32), frame.tag)
        labels.add(observation, T)
        added = None
        if k % 4 == 0:
            added = MappedScan(beams, np.ones(3, np.float32), T, 0.25 * k)
            frame.add(added, Registration(T, np.eye(3), 1.0, np.zeros((3, 3)), np.zeros(3)))
        if k == 4 * 2 * CARRIED - 1:
            since = np.arange(len(closer.poses)) > CARRIED
            moved = np.where(since[:, None, None], MOTION @ closer.poses, closer.poses)
            closer.found = Correction(MOTION, moved, [])
        frame.correct(observation, added)
    return frame, labels, np.array(poses), np.array(anchors)


def test_poses_move_with_those_after(run):
    frame, _, poses, anchors = run
    carried = 4 * CARRIED + 2
    moved = frame.to_map_all(poses, anchors)
    np.testing.assert_allclose(moved[:carried], poses[:carried], atol=1e-9)
    np.testing.assert_allclose(moved[carried:], MOTION @ poses[carried:], atol=1e-9)
    for scan in (carried - 1, carried, carried + 2, len(poses) - 1):
        found = frame.to_map(poses[scan], anchors[scan], scan)
        np.testing.assert_allclose(found, moved[scan], atol=1e-9)


def test_cells_move_with_the_scans_after(run):
    _, labels, poses, _ = run
    known = labels.known_cells()
    at = 0.05 * (known.cells + 0.5)
    seen = poses[:, 0, 2] + 2.0
    for k, x in enumerate(seen):
        near = np.abs(at[:, 0] - x) < 0.06
        expected = 0.0 if k < 4 * CARRIED + 2 else 3.0
        np.testing.assert_allclose(at[near, 1], expected, atol=0.1)


BEAMS, BINS, MEANWHILE = 720, 6, 12  # time bins before the correction, and while it goes on
# by whole cells: none is seen between two of them
BY_CELLS = se2.matrix(2.0, -1.0, 0.0)


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
        Correction(BY_CELLS, BY_CELLS[None], []), labels, here, here, np.array([0])
    )
    scans, is_done, blocks = iter(scans), False, []
    while not is_done:
        scan = next(scans, None)
        if scan is not None:
            labels.add(scan, scan.T)
            correction.note_labelled(scan)
        is_done = correction.step()
        blocks.append(correction._block)
    correction.finish()
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
    take_over(moved, expected.filter, BY_CELLS[None], 0, expected.filter.block_count)
    expected.filter = moved
    ours, theirs = states(found), states(expected)
    both = np.array([(ours[cell], theirs[cell]) for cell in ours.keys() & theirs.keys()])
    assert len(both) > 0.95 * len(ours.keys() | theirs.keys())
    assert len(both) > 1000
    off = np.abs(both[:, 0] - both[:, 1])
    assert np.mean(off > 0.02) < 0.02
