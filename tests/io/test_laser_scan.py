"""2D recordings in the form of LaserScan messages."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import of_one_sensor

from stillmap.core.source import SensorNotes, Source
from stillmap.io import laser_scan


def recording(scans, *, sensors=(), beam_time=None):
    """A recording of scans given by (angles, ranges); NaN ranges are unusable beams."""
    points = [
        np.stack([r * np.cos(a), r * np.sin(a)], axis=-1)
        for a, r in ((np.asarray(a, float), np.asarray(r, float)) for a, r in scans)
    ]
    flat = np.concatenate(points).astype(np.float32)
    return of_one_sensor(
        np.arange(len(scans), dtype=np.int64),
        np.concatenate([[0], np.cumsum([len(p) for p in points])]).astype(np.int64),
        flat,
        ~np.isnan(flat[:, 0]),
        source=Source(sensors=list(sensors)),
        beam_time=None if beam_time is None else np.asarray(beam_time, np.float32),
    )


@settings(max_examples=60, deadline=None)
@given(
    start=st.floats(-6.0, 6.0),
    degrees=st.floats(0.05, 2.0),
    falling=st.booleans(),
    n=st.integers(2, 400),
    seed=st.integers(0, 1000),
)
def test_angles_are_found_in_the_points(start, degrees, falling, n, seed):
    rng = np.random.default_rng(seed)
    step = np.radians(degrees) * (-1 if falling else 1)
    ranges = rng.uniform(0.1, 80.0, n)
    lost = rng.random(n) < rng.uniform(0.0, 0.5)
    lost[rng.choice(n, 2, replace=False)] = False
    ranges[lost] = np.nan
    seen = np.flatnonzero(~lost)
    if np.diff(seen).min() * abs(step) > 3.0:
        return  # neighbours more than half a turn apart tell nothing
    angles = start + step * np.arange(n)
    (first, found) = laser_scan.beam_angles(recording([(angles, ranges)]))[0]
    off = (first + found * seen - angles[seen] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(off).max() < 1e-6


def test_what_the_reader_noted_comes_first():
    angles, noted = np.linspace(-1.0, 1.0, 21), SensorNotes(start_angle=-1.0, angle_step=0.1)
    one = recording([(angles, np.full(21, 5.0))], sensors=[noted])
    assert laser_scan.beam_angles(one).tolist() == [[-1.0, 0.1]]


def test_a_scan_that_tells_nothing_has_the_angles_of_the_others():
    angles, blind = np.linspace(-1.0, 1.0, 21), np.full(21, np.nan)
    scans = [(angles, blind), (angles, np.full(21, 5.0)), (angles, blind)]
    np.testing.assert_allclose(
        laser_scan.beam_angles(recording(scans)), [[-1.0, 0.1]] * 3, atol=1e-7
    )
    assert np.isfinite(laser_scan.beam_angles(recording([(angles, blind)]))).all()


def test_even_times_are_a_step_from_beam_to_beam():
    scan = (np.arange(5) * 0.1, np.ones(5))
    even, uneven = 0.01 * np.arange(5), [0.0, 0.01, 0.025, 0.03, 0.04]
    falling, late = -even, 0.1 + even
    one = recording([scan] * 4, beam_time=[*even, *falling, *late, *uneven])
    steps, n_uneven = laser_scan.time_increments(one)
    np.testing.assert_allclose(steps, [0.01, -0.01, 0.0, 0.0], atol=1e-8)
    assert n_uneven == 2
    steps, n_uneven = laser_scan.time_increments(recording([scan]))
    assert (steps.tolist(), n_uneven) == ([0.0], 0)
