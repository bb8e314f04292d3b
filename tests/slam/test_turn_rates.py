"""Latency of odometry on made-up headings."""

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.slam.scan_motion import MotionWindows
from stillmap.slam.turn_rates import fit_latency

T = 400
SECONDS = 0.2 * np.arange(T)
SEGMENT = 40  # scans


def heading(seconds):
    """Turns of 0.8 rad/s to either side with pauses."""
    t = np.arange(-5.0, SECONDS[-1] + 5.0, 0.01)
    rate = 0.8 * np.sign(np.sin(0.9 * t)) * (np.sin(2.3 * t + 1.0) > 0.2)
    return np.interp(seconds, t, 0.01 * np.cumsum(rate))


def windows_of(angles):
    """Steps of segments of one laser with these headings (T,) at the stamps."""
    first = np.concatenate(
        [np.arange(k, k + SEGMENT - 1) for k in range(0, T - SEGMENT + 1, SEGMENT)]
    )
    steps = np.stack([first, first + 1], axis=-1)
    none = np.zeros(0, np.intp)
    return MotionWindows(
        none,
        none,
        none,
        np.zeros((0, 3)),
        np.zeros((0, 3, 3)),
        steps,
        np.diff(angles)[first],
        first // SEGMENT,
    )


def odometry(late, rng, noise):
    steps = np.diff(heading(SECONDS - late), prepend=0.0)
    steps += noise * np.sqrt(np.abs(steps)) * rng.standard_normal(T)
    return se2.matrix(0.0, 0.0, 0.95 * np.cumsum(steps))


@pytest.mark.parametrize("late", [-0.35, 0.0, 0.1, 0.2, 0.45])
@pytest.mark.parametrize("mirrored", [1.0, -1.0])
def test_latency(late, mirrored):
    rng = np.random.default_rng(7)
    angles = heading(SECONDS) + 0.001 * rng.standard_normal(T)
    fit = fit_latency(windows_of(mirrored * angles), SECONDS, odometry(late, rng, 0.03))
    assert fit.latency == pytest.approx(late, abs=0.02)
    assert abs(fit.latency - late) < 5 * fit.std
    assert fit.std < 0.02
    assert fit.explained > 0.9


def test_noise_alone_shows_no_latency():
    """Interpolated odometry has less noise half way between two scans: no reason to be late."""
    found = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        fit = fit_latency(windows_of(heading(SECONDS)), SECONDS, odometry(0.0, rng, 0.2))
        found.append(fit.latency)
    assert abs(np.mean(found)) < 0.03


def test_no_turns():
    rng = np.random.default_rng(0)
    still = se2.matrix(0.0, 0.0, 0.001 * rng.standard_normal(T))
    fit = fit_latency(windows_of(0.001 * rng.standard_normal(T)), SECONDS, still)
    assert fit.explained < 0.5


def test_few_scans():
    windows = windows_of(heading(SECONDS))
    few = np.zeros(10, np.bool_)
    few[0] = True
    rng = np.random.default_rng(0)
    short = fit_latency(windows, SECONDS[:T], odometry(0.2, rng, 0.03), ~few & few)
    assert short.std == np.inf
