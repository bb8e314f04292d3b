"""Occupancy of cells after the labels of their beams changed."""

import dataclasses

import numpy as np
import pytest
from recordings import of_one_sensor
from synthetic_histories import course

from stillmap.em import CellProbabilities
from stillmap.mapping import update_occupancy
from stillmap.mapping.labelled_recording import LabelledRecording


class _SurfelOfBeams:
    """Beams end in cell 0, 0, 1, 1 and none, scan by scan."""

    def associate_beams(self, points, hit, offset, T, threads):  # noqa: ARG002
        assert threads == 1
        assert len(hit) == len(points)
        return np.array([0, 0, 1, 1, -1] * (len(points) // 5))


def updated(before, after, share):
    n = 2
    recording = of_one_sensor(
        np.arange(n, dtype=np.int64) * 10**8,
        np.arange(n + 1, dtype=np.int64) * 5,
        np.ones((5 * n, 2), np.float32),
        np.ones(5 * n, bool),
    )
    cells = np.array([[1, 1], [5, 5]])
    histories = course(cells, True, share=share)
    histories = dataclasses.replace(histories, surfel_map=_SurfelOfBeams())
    occupied = CellProbabilities(cells, np.full(2, 0.05, np.float32), 0.2)
    poses = np.tile(np.eye(3), (n, 1, 1))
    old, new = (np.tile(np.array(row, np.float32), n) for row in (before, after))
    known = LabelledRecording(recording, poses, old, 0.1)
    return update_occupancy(known, new, histories, occupied).p_occupied


def test_cells_of_movers_stay_and_clutter_becomes_an_obstacle_if_it_was_there_for_long():
    before, after = [0.05, 0.05, 0.05, 0.05, 0.05], [0.05, 0.05, 1.0, 1.0, 1.0]
    stays, often = updated(before, after, share=0.6)
    assert stays == pytest.approx(0.05)
    assert often > 0.65
    assert updated(before, after, share=0.02)[1] < 0.2


def test_a_cell_of_both_lies_between():
    before = [0.05] * 5
    both = updated(before, [0.05, 1.0, 1.0, 1.0, 1.0], share=0.8)
    assert 0.05 < both[0] < both[1]
    assert both[0] == pytest.approx(0.5 * (0.05 + both[1]), abs=0.01)


def test_a_cell_whose_beams_movers_explain_is_less_of_an_obstacle():
    before, after = [0.8, np.nan, 0.8, 0.8, 0.8], [0.2, np.nan, 0.8, 0.8, 0.8]
    explained, stays = updated(before, after, share=0.5)
    assert explained == pytest.approx(0.05 / 4.0)
    assert stays == pytest.approx(0.05)
