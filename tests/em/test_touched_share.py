"""Share of the scans whose labels changed enough to be matched differently."""

import dataclasses

import numpy as np
import pytest

from stillmap import em
from stillmap.sim import scene_by_name, simulate


@pytest.fixture(scope="module")
def recording():
    return simulate(scene_by_name("hall-empty", {"robot": {"scans": 4}}), 0).recording


def change(recording, shares, by=0.5):
    """Labels before, and after a change in these shares of the hits of each scan."""
    before = np.full(recording.n_beams, 0.9, np.float32)
    after = before.copy()
    for t, share in enumerate(shares):
        hits = recording.beams_of(t).start + np.flatnonzero(recording.hit[recording.beams_of(t)])
        after[hits[: round(share * len(hits))]] -= by
    return before, after


def test_scans_with_a_fifth_of_their_hits_changed(recording):
    assert em.touched_share(recording, *change(recording, [0, 0, 0, 0])) == 0.0
    assert em.touched_share(recording, *change(recording, [0.3, 0.1, 1.0, 0.1])) == 0.5
    assert em.touched_share(recording, *change(recording, [0.3, 0.3, 0.3, 0.3], by=0.05)) == 0.0


def test_beams_without_a_return_do_not_count(recording):
    before, after = change(recording, [0, 0, 0, 0])
    after[~recording.hit] = 0.0
    assert em.touched_share(recording, before, after) == 0.0
    blind = dataclasses.replace(recording, hit=np.zeros_like(recording.hit))
    assert em.touched_share(blind, before, after) == 0.0


def test_from_the_default_prior_to_certainty_is_no_change(recording):
    """In single precision 1 - 0.9 exceeds 0.1."""
    before = np.full(recording.n_beams, em.EmOptions().prior, np.float32)
    certain = np.ones(recording.n_beams, np.float32)
    assert (certain - before > 0.1).all()
    assert em.touched_share(recording, before, certain) == 0.0
    assert em.changed_share(before, certain, recording.hit) == 0.0
