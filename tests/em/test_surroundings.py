"""Surroundings: what lets some beams pass is static, what moves past it is dynamic."""

import numpy as np
import porous_street as street
import pytest

from stillmap import em
from stillmap.em import occupancy_hmm
from stillmap.em.observations import likelihood_of_misses

STATIC_THINGS = {"hedge": street.HEDGE, "post": street.POST, "car": street.CAR}


@pytest.fixture(scope="module")
def seen():
    return street.watch()


def dynamic_share(found, seen, thing):
    return float((found.p_static[seen.thing == thing] < 0.5).mean())


@pytest.fixture(scope="module")
def found(seen):
    return occupancy_hmm.e_step_3d(seen.recording, seen.poses, 0.15, em.EmOptions())


@pytest.fixture(scope="module")
def without(seen):
    """As if nothing was known of surroundings."""
    collect = occupancy_hmm.collect_observations

    def collect_without(*args, with_surroundings=False, **kwargs):  # noqa: ARG001
        return collect(*args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(occupancy_hmm, "collect_observations", collect_without)
        return occupancy_hmm.e_step_3d(seen.recording, seen.poses, 0.15, em.EmOptions())


@pytest.mark.parametrize("name", STATIC_THINGS)
def test_porous_things_are_static(found, seen, name):
    thing = STATIC_THINGS[name]
    assert (seen.thing == thing).sum() > 3000
    assert dynamic_share(found, seen, thing) < 0.06


def test_surroundings_tell_it(found, without, seen):
    for thing in (street.HEDGE, street.CAR):
        assert dynamic_share(found, seen, thing) < 0.4 * dynamic_share(without, seen, thing)


def test_the_walker_is_dynamic(found, seen):
    assert dynamic_share(found, seen, street.WALKER) > 0.99
    assert dynamic_share(found, seen, street.SOLID) < 0.01


def counts(*rows):
    return np.array(rows, np.float32)


def test_without_misses_surroundings_say_nothing():
    np.testing.assert_array_equal(likelihood_of_misses(counts((0, 0), (0.4, 0.4))), 1.0)


def test_likelihood_of_misses():
    # Beta(9, 1): P(hit around | one miss) is 9 / 10, and 1 / 10 where surroundings empty
    p = likelihood_of_misses(counts((1, 1), (1, 0), (2, 1)))
    assert p.dtype == np.float32
    np.testing.assert_allclose(p, [[1, 1 / 9], [1 / 9, 1], [1, 1]], rtol=1e-5)
    # B(11, 1) / B(9, 1) and B(3, 9) / B(1, 9)
    np.testing.assert_allclose(
        likelihood_of_misses(counts((2, 2)))[0, 1], (2 / (10 * 11)) / (9 / 11), rtol=1e-5
    )


def test_many_misses_count_as_twenty():
    few, many = likelihood_of_misses(counts((20, 15), (400, 300)))
    np.testing.assert_array_equal(few, many)
    assert np.isfinite(likelihood_of_misses(counts((1e6, 1e6), (1e6, 0)))).all()
