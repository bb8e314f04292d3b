"""`paper` is the method as printed: poses by (9) alone, one scan after the other."""

import numpy as np
import pytest

import stillmap
from stillmap import em, slam
from stillmap.core.config import override
from stillmap.pipeline.options import Options, resolve_options

SLAM = slam.SlamOptions()


def options(estimator="paper", loops=True):
    changes = {
        "estimator": estimator,
        "threads": 1,
        "em": {"max_iterations": 3, "tolerance": 0.0, "label_tolerance": 0.0},
        "slam": {"loop_closure": loops},
    }
    return override(Options(), changes)


def everything(result):
    numbers = [(it.bound, it.expected_log_likelihood, it.changed_share) for it in result.iterations]
    arrays = (result.poses, result.estimate.m_step.covariance, result.p_static)
    maps = [m for o in (result.map, result.raw_map) for m in (o.p_occupied, o.alpha, o.beta)]
    return numbers, result.best_iteration, [a.tobytes() for a in (*arrays, *maps)]


@pytest.fixture
def printed(room):
    return stillmap.build(room.recording, options())


def test_loop_closure_has_no_part_in_it(room, printed):
    without = stillmap.build(room.recording, options(loops=False))
    assert everything(without) == everything(printed)
    assert printed.loops == []
    # with the default estimator it has
    ours = [stillmap.build(room.recording, options("stillmap", on)) for on in (True, False)]
    assert ours[0].poses.tobytes() != ours[1].poses.tobytes()


def test_it_is_the_loop_of_fig_2(room):
    # written out once more: register scan by scan, map, label, repeat
    r, chosen = room.recording, options()
    plain = override(SLAM, {"loop_closure": False, "deskew": False})
    e = np.full(r.n_beams, chosen.em.prior, np.float32)
    n = 0
    for it in stillmap.iterate(r, chosen):
        mapped = slam.m_step(r, e, plain, None, 1, lambda *_: None, free_space_margin=0.0)
        np.testing.assert_array_equal(it.estimate.poses, mapped.poses)
        np.testing.assert_array_equal(it.estimate.m_step.covariance, mapped.covariance)
        for ours, theirs in zip(it.estimate.m_step.grid.dense(), mapped.grid.dense(), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        found = em.e_step(r, mapped.poses, mapped.grid, "paper", chosen.em)
        np.testing.assert_array_equal(it.estimate.p_static, found.p_static)
        assert it.estimate.e_step.likelihood == found.likelihood
        e = found.p_static
        n += 1
    assert n == 3


def test_the_options_that_are_kept_are_those_that_were_used(printed):
    assert not printed.options.slam.loop_closure
    assert not printed.options.slam.deskew
    # all else as it was asked for, and other estimators as they were
    assert override(printed.options, {"slam": {"loop_closure": True, "deskew": True}}) == options()
    for estimator in ("stillmap", "hit-ratio", "tracker"):
        chosen = options(estimator)
        assert resolve_options(chosen, printed.recording) == chosen
