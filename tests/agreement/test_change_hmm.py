"""Change HMM: kernel against twin on lanes with one cell each, and by hand."""

import numpy as np
import pytest
import reference
from surfel_maps import fit_surfels

from stillmap import _core

LANES, BINS = 120, 160
SECONDS = 0.5
MODEL = {"tau": 300.0, "passer_by_rho": 0.1, "passer_by_tau": 1.5, "p_detection": 0.9}
NOT_SEEN, HIT, THROUGH = range(3)


def lanes(seed=3):
    """(LANES, BINS) observations of each lane drawn from the model, and their time bins."""
    rng = np.random.default_rng(seed)
    number = np.cumsum(rng.choice([1, 1, 1, 2, 5, 70], BINS)) + 3
    model = reference.ChangeModel(**MODEL)
    state = rng.choice(3, LANES, p=model.prior)
    seen = np.empty((LANES, BINS), int)
    for k in range(BINS):
        p = model.transition(SECONDS * (number[k] - number[k - 1]) if k else 0.0)
        state = np.array([rng.choice(3, p=p[s]) for s in state])
        struck = (state != reference.change_hmm.EMPTY) & (rng.random(LANES) < 0.9)
        seen[:, k] = np.where(struck, HIT, THROUGH)
    seen[rng.random(seen.shape) < 0.3] = NOT_SEEN
    seen[:, 0] = HIT  # one return each
    seen[:4, 1:] = NOT_SEEN  # observed once
    return seen, number


def beams_of(seen):
    """Beams, and the time bin of each: scans of their own, which start at x = 0 of their lane.

    Lanes are 1 m apart; beams end in the cell at x = 2.05, or behind it.
    """
    bins, lane = np.nonzero(seen.T != NOT_SEEN)
    reach = np.where(seen[lane, bins] == HIT, 2.05, 4.05)
    along = np.stack([reach, np.zeros(len(lane))], axis=1).astype(np.float32)
    T = np.tile(np.eye(3), (len(lane), 1, 1))
    T[:, 1, 2] = (lane + 0.05).astype(np.float32)
    return along, np.ones(len(lane), bool), np.arange(len(lane) + 1), T, bins


def changes_of(kernels, seen, number, threads=1, chunk=None, **asked):
    along, hit, own, T, bins = beams_of(seen)
    surface = fit_surfels(kernels, "SurfelMap2D", 0.1, along, hit, own, T)
    lengths = {"lateral_std": 0.001, "margin": 0.2, "hit_radius": 0.05, "end_margin": 0.3}
    model = {"rho": [0.5], "tau": [1.0], "p_detection": 0.9, "bin_seconds": SECONDS}
    hmm = kernels.OccupancyHmm2D(surface, **model, **lengths, use_normals=False)
    hmm.track_changes(**MODEL, **asked)
    step = chunk or len(number)
    for first in range(0, len(number), step):
        of = np.flatnonzero((bins >= first) & (bins < first + step))
        part = slice(of[0], of[-1] + 1)
        hmm.add(along[part], hit[part], own[: len(of) + 1], T[part], number[bins[part]], threads)
    cells = surface.surfels()[0]
    at = np.flatnonzero(cells[:, 0] == 20)
    order = at[np.argsort(cells[at, 1])]
    found = hmm.changes() if asked.get("with_paths", True) else [hmm.change_log_likelihood()]
    return [values[order] for values in found]


@pytest.fixture(scope="module")
def both():
    seen, number = lanes()
    return changes_of(_core, seen, number), changes_of(reference, seen, number)


def test_likelihood_and_last_state(both):
    core, plain = both
    assert len(plain[0]) == LANES
    np.testing.assert_allclose(core[0], plain[0], rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(core[2], plain[2], atol=2e-4)
    assert np.ptp(plain[0]) > 50
    assert ((plain[2][:, 0] > 0.9).sum() > 10) & ((plain[2][:, 0] < 0.1).sum() > 10)


def test_viterbi_path(both):
    core, plain = both
    for k in (3, 4):
        np.testing.assert_array_equal(core[k], plain[k])
        assert core[k].dtype == np.int32
    np.testing.assert_allclose(core[1], plain[1], atol=1e-5)
    count = plain[3]
    assert (count[:, 0] == 0).any() & (count[:, 0] == 1).any() & (count[:, 0] > 2).any()
    assert (count[:, 1] > count[:, 0]).any()
    assert (plain[4][:4] == -1).all()  # no changes in one observation
    np.testing.assert_array_equal(plain[1][:4], 1)


@pytest.mark.parametrize(("threads", "chunk"), [(3, None), (1, 7), (2, 50)])
def test_threads_and_chunks_give_the_same_bits(both, threads, chunk):
    seen, number = lanes()
    for one, other in zip(both[0], changes_of(_core, seen, number, threads, chunk), strict=True):
        assert one.tobytes() == other.tobytes()


def test_likelihood_without_paths(both):
    [found] = changes_of(_core, *lanes(), with_paths=False)
    assert found.tobytes() == both[0][0].tobytes()


def by_hand(pattern):
    """Changes of a cell that is hit (H), missed (T) or unobserved (.) in each time bin."""
    observations = [(k, None if c == "H" else 1.0) for k, c in enumerate(pattern) if c != "."]
    return reference.summarise_changes(
        observations, SECONDS, reference.ChangeModel(60.0, 0.05, 2.0, 0.97)
    )


@pytest.mark.parametrize(
    ("pattern", "count", "first", "last"),
    [
        ("T" * 30 + "H" * 30, 1, (29, 30), (29, 30)),
        ("H" * 30 + "." * 9 + "T" * 30, 1, (29, 39), (29, 39)),
        ("T" * 30 + "H" * 40 + "T" * 30, 2, (29, 30), (69, 70)),
        ("T" * 30 + "HH" + "T" * 30, 0, (-1, -1), (-1, -1)),  # a passer-by
        ("H" * 30 + "T" + "H" * 30, 0, (-1, -1), (-1, -1)),  # one false miss
    ],
)
def test_changes_by_hand(pattern, count, first, last):
    found = by_hand(pattern)
    assert found.count[0] == count
    assert found.change_bins[0] == (first, last)


def test_two_observations_by_hand():
    model = reference.ChangeModel(60.0, 0.05, 2.0, 0.97)
    p = model.transition(0.5)
    np.testing.assert_allclose(p.sum(axis=1), 1)
    np.testing.assert_allclose(model.prior @ p, model.prior)  # stationary
    hit_hit = sum(model.prior[a] * 0.97 * p[a, b] * 0.97 for a in (0, 2) for b in (0, 2))
    expected = np.log(hit_hit / (0.525 * 0.97))
    assert by_hand("HH").log_likelihood == pytest.approx(expected)
