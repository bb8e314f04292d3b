"""Recordings in chunks of scans."""

import numpy as np
import pytest
from recordings import of_one_sensor

from stillmap.core import chunks

GROUPS = np.array([0, 0, 0, 1, 1, 4, 5, 5, 5, 5])


def ten_scans():
    return of_one_sensor(
        np.arange(10), 100 * np.arange(11), np.zeros((1000, 2), np.float32), np.ones(1000, bool)
    )


def cuts(beams, monkeypatch, **which):
    monkeypatch.setattr(chunks, "CHUNK_BEAMS", beams)
    found = list(chunks.iter_chunks(ten_scans(), **which))
    for chunk in found:
        assert chunk.beams == slice(100 * chunk.scans.start, 100 * chunk.scans.stop)
        assert chunk.offset.tolist() == [100 * k for k in range(len(chunk.offset))]
    assert [c.scans.start for c in found] == [0, *(c.scans.stop for c in found[:-1])]
    return [chunk.scans.stop for chunk in found]


@pytest.mark.parametrize(
    ("beams", "stops"), [(1, list(range(1, 11))), (250, [2, 4, 6, 8, 10]), (10**6, [10])]
)
def test_chunks_are_no_larger_than_asked_for(beams, stops, monkeypatch):
    assert cuts(beams, monkeypatch) == stops


@pytest.mark.parametrize(("beams", "stops"), [(1, [3, 5, 6, 10]), (600, [6, 10]), (950, [6, 10])])
def test_no_group_is_cut(beams, stops, monkeypatch):
    assert cuts(beams, monkeypatch, group=GROUPS) == stops


@pytest.mark.parametrize(
    ("beams", "groups", "stops"),
    [(99, 2, [5, 10]), (99, 3, [6, 10]), (99, 9, [10]), (600, 2, [6, 10]), (1, 1, [3, 5, 6, 10])],
)
def test_threads_find_groups_to_share(beams, groups, stops, monkeypatch):
    assert cuts(beams, monkeypatch, group=GROUPS, min_groups=groups) == stops


@pytest.mark.parametrize(("beams", "stops"), [(50, [5, 10]), (20, [3, 5, 10])])
def test_however_many_threads_chunks_are_no_wider(beams, stops, monkeypatch):
    assert cuts(beams, monkeypatch, group=GROUPS, min_groups=200) == stops
