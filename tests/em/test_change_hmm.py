"""Change points: objects that arrive, leave or come and go, and what the map shows of them."""

from typing import NamedTuple
from unittest import mock

import numpy as np
import pytest
from made_up import RESOLUTION, ROOM, Ball, passing, watch

from stillmap import em
from stillmap.core import chunks
from stillmap.em.change_hmm import _group_cells
from stillmap.mapping import detect_changes, relabel_changes
from stillmap.mapping.labelled_recording import LabelledRecording

CAME, LEFT, STANDS, STOOD, PASSED = 3, 4, 5, 6, 7
SECONDS = 200
STATES = ("last", "majority")


def histories(**changed):
    """Four cells unless others are given: static; came and shown; left; comes and goes."""
    usual = {
        "cells": np.array([[0, 0], [1, 0], [2, 0], [3, 0]]),
        "p_static": np.array([0.9, 0.1, 0.2, 0.05], np.float32),
        "p_view_dependent": np.zeros(4, np.float32),
        "p_changing": np.array([0.02, 0.8, 0.7, 0.9], np.float32),
        "p_object": np.array([0.5, 1.0, 0.0, 0.9], np.float32),
        "occupied_share": np.array([1.0, 0.3, 0.6, 0.7], np.float32),
        "n_changes": np.array([0, 1, 1, 3], np.int32),
        "change_bins": np.full((4, 2, 2), -1, np.int32),
        "changing_weight": 0.1,
        "surfel_map": None,
    }
    chosen = usual | changed
    return em.CellHistories(**chosen, p_in_cell=np.ones(len(chosen["cells"]), np.float32))


def test_states_of_the_map():
    # what comes and goes is not there at last, whatever was seen at last
    shown = histories().p_in_map("last")
    np.testing.assert_allclose(shown, [0.91, 0.9, 0.2, 0.05], atol=1e-6)
    assert shown.dtype == np.float32
    twice = histories(n_changes=np.array([0, 2, 2, 2], np.int32)).p_in_map("last")
    np.testing.assert_allclose(twice, [0.91, 0.9, 0.2, 0.05 + 0.9 * 0.9], atol=1e-6)
    mostly = histories().p_in_map("majority")
    np.testing.assert_allclose(mostly, [0.92, 0.1, 0.9, 0.95], atol=1e-6)
    half = histories(occupied_share=np.full(4, 0.5, np.float32)).p_in_map("majority")
    np.testing.assert_allclose(half, histories().p_static)
    # where the view may hide something as well, what is listed as a change is shown as one
    unsure = {name: 0.5 * getattr(histories(), name) for name in ("p_static", "p_changing")}
    hidden = histories(**unsure, p_view_dependent=np.full(4, 0.5, np.float32))
    for state in STATES:
        expected = histories().p_in_map(state)
        np.testing.assert_allclose(hidden.p_in_map(state), expected, atol=1e-6)


def row(p_changing, *, count=1, static=0.01, apart=1):
    """Cells in a row that changed alike."""
    n = len(p_changing)
    return histories(
        cells=np.column_stack([apart * np.arange(n), np.zeros(n)]).astype(np.int64),
        p_static=np.full(n, static, np.float32),
        p_view_dependent=np.zeros(n, np.float32),
        p_changing=np.array(p_changing, np.float32),
        p_object=np.full(n, 0.9, np.float32),
        occupied_share=np.full(n, 0.5, np.float32),
        n_changes=np.full(n, count, np.int32),
        change_bins=np.tile(np.array([(10, 12)] * 2, np.int32), (n, 1, 1)),
    )


def same(histories):
    return np.array_equal(_group_cells(histories).p_changing, histories.p_changing)


THIRD = [*[0.9] * 5, 0.8, *[0.1] * 10]


def test_cells_outside_groups_are_unchanged():
    assert not same(row(THIRD))
    assert same(row(THIRD[4:7]))  # too few cells
    assert same(row(THIRD, apart=4))
    assert not same(row(THIRD, apart=3))
    assert same(row(THIRD, count=0))  # nothing changed
    assert same(row(THIRD, count=3))  # it comes and goes
    assert same(row(THIRD, static=0.5))
    assert same(row([0.9, 0.9, 0.9, *[0.02] * 10]))  # most have no say


@pytest.fixture(scope="module")
def seen():
    """A box appears, one leaves and somebody walks over its place, one stands, one waits a bit."""
    things = [
        Ball(3.0, 1.5, 120, SECONDS, 0.5),
        Ball(2.2, -1.4, 0, 140, 0.5),
        Ball(3.2, 0.0, 0, SECONDS, 0.4),
        Ball(1.5, 2.0, 20, 50, 0.3),
    ]
    return watch([*ROOM, *things, *passing(160, 2.0), *passing(180, 1.9)], SECONDS)


class Everywhere(NamedTuple):
    """A place that is all there is."""

    cells: np.ndarray
    door: None = None
    resolution: float = 0.0  # too small for the leaf of a door


def final_e_step(seen, state="last", threads=1, **options):
    """(p_static, occupied) of a map that shows it everywhere, and the histories."""
    chosen = em.EmOptions(**options)
    _, found = em.final_e_step(seen.recording, seen.poses, RESOLUTION, chosen, threads)
    all_static = np.ones(seen.recording.n_beams, np.float32)
    before = em.CellProbabilities(found.cells, np.zeros(len(found.cells), np.float32), 0.2)
    places = [Everywhere(found.cells)]
    # each cell decides alone
    alone = "stillmap.mapping.changed_objects.pool_states"
    with mock.patch(alone, lambda histories, *_: histories.share_there(state)):
        known = LabelledRecording(seen.recording, seen.poses, all_static, RESOLUTION, threads)
        shown = relabel_changes(known, before, found, places, state)
    return shown, found


@pytest.fixture(scope="module")
def shown(seen):
    return {state: final_e_step(seen, state) for state in STATES}


@pytest.mark.parametrize(
    ("state", "there", "absent"), [("last", CAME, LEFT), ("majority", LEFT, CAME)]
)
def test_labels_of_either_map(seen, shown, state, there, absent):
    e = shown[state][0][0]
    assert np.median(seen.of(e, there)) > 0.9
    assert np.quantile(seen.of(e, absent), 0.9) < 0.1
    assert np.quantile(seen.of(e, STANDS), 0.02) > 0.95
    assert np.quantile(seen.of(e, *range(CAME)), 0.02) > 0.9
    assert np.quantile(seen.of(e, STOOD), 0.95) < 0.1


def test_walkers_over_a_left_place_are_dynamic(seen, shown):
    (e, _), found = shown["last"]
    over = seen.of(e, *range(PASSED, PASSED + 10))
    assert len(over) > 80
    assert np.quantile(over, 0.95) < 0.1
    assert (found.n_changes[found.p_changing > 0.5] <= 1).all()  # and nothing came back


@pytest.mark.parametrize("state", STATES)
def test_labels_follow_from_the_map(seen, shown, state):
    (p_static, occupied), found = shown[state]
    in_map = dict(zip(map(tuple, found.cells.tolist()), found.p_in_map(state), strict=True))
    hit = seen.recording.hit
    ends = np.floor(seen.recording.points[hit].astype(float) / RESOLUTION).astype(int)
    expected = np.array([in_map[tuple(cell)] for cell in ends.tolist()], np.float32)
    np.testing.assert_array_equal(p_static[hit], expected)
    # and no cell is more occupied than what is shown of it
    np.testing.assert_array_equal(occupied.cells, found.cells)
    assert (occupied.p_occupied <= found.p_in_map(state)).all()


def test_change_times(seen, shown):
    found = detect_changes(shown["last"][1], seen.recording, RESOLUTION, 0.5)
    assert [one.kind for one in found] == ["came", "left"]
    assert [(one.before_ns, one.stamp_ns) for one in found] == [
        (119 * 10**9, 120 * 10**9),
        (139 * 10**9, 140 * 10**9),
    ]
    # the side towards the sensor
    assert (found[0].x, found[0].y) == pytest.approx((2.67, 1.31), abs=0.1)
    assert (found[1].x, found[1].y) == pytest.approx((1.87, -1.16), abs=0.1)


def test_recurring_changes():
    times = [(t, t + 25) for t in range(0, 300, 50)]
    gate = [Ball(2.2, 0.3, *time, 0.5) for time in times]
    watched = watch([*ROOM, *gate, *passing(35, 1.2)], 300)
    (p_static, _), found = final_e_step(watched)
    assert np.median(watched.of(p_static, *range(3, 3 + len(gate)))) < 0.1
    (one,) = detect_changes(found, watched.recording, RESOLUTION, 0.5)
    assert one.kind == "comes and goes"
    assert one.times == 11
    assert (one.stamp_ns, one.last_ns) == (25 * 10**9, 275 * 10**9)


@pytest.mark.parametrize(("beams", "threads"), [(1000, 1), (5000, 3)])
def test_chunks_and_threads_change_no_bit(seen, shown, monkeypatch, beams, threads):
    monkeypatch.setattr(chunks, "CHUNK_BEAMS", beams)
    (p_static, _), found = final_e_step(seen, threads=threads)
    (expected, _), of_all = shown["last"]
    assert p_static.tobytes() == expected.tobytes()
    assert found.change_bins.tobytes() == of_all.change_bins.tobytes()


@pytest.mark.parametrize(("scans", "things"), [(1, ROOM), (2, ROOM), (10, ())])
def test_short_recordings_and_those_without_hits_have_no_changes(scans, things):
    watched = watch(things, scans)
    (p_static, _), found = final_e_step(watched)
    assert detect_changes(found, watched.recording, RESOLUTION, 0.5) == []
    assert np.isfinite(p_static).all()
    assert (len(found.cells) == 0) == (not things)
