"""Sweeps as a planar laser would have seen them, worked by hand."""

import numpy as np
import pytest
from recordings import of_one_sensor

from stillmap import em
from stillmap.em.types import GroundMap
from stillmap.mapping.projection import project_cells, project_to_plane

BAND = (0.2, 1.8)
SENSOR = 1.5


def flat_ground(sensor=SENSOR, z=0.0):
    return GroundMap(np.full((40, 40), z), np.array([-20.0, -20.0]), sensor, True)


def sweep(ends, hit=None, z=0.0):
    """A recording of one sweep of beams from (0, 0, SENSOR) above ground at z, and its pose."""
    ends = np.asarray(ends, np.float64)
    T = np.eye(4)
    T[2, 3] = SENSOR + z
    recording = of_one_sensor(
        np.zeros(1, np.int64),
        np.array([0, len(ends)], np.int64),
        (ends - [0, 0, SENSOR]).astype(np.float32),
        np.ones(len(ends), bool) if hit is None else np.asarray(hit),
    )
    return recording, T[None]


def planned(ends, hit=None, z=0.0, open_space=False, sensor=SENSOR):
    recording, poses = sweep(ends, hit, z)
    plan = project_to_plane(recording, poses, flat_ground(sensor, z), BAND, 0.1, open_space)
    order = np.argsort(plan.beam)
    points = plan.recording.points[order]
    return points, plan.recording.hit[order], plan.beam[order]


@pytest.mark.parametrize("z", [0.0, 12.0])
def test_what_stands_in_the_band_is_hit_where_it_stands(z):
    points, hit, beam = planned([[5, 0, 1.0], [0, 3, 0.25]], z=z)
    np.testing.assert_allclose(points, [[5, 0], [0, 3]], atol=1e-5)
    assert hit.all()
    assert beam.tolist() == [0, 1]


def test_beams_to_the_ground_show_free_space_until_they_leave_the_band():
    # from 1.5 m down to the ground at 10 m: 0.2 m above it after (1.5 - 0.2) / 1.5 of the way
    points, hit, _ = planned([[10, 0, 0.0]])
    np.testing.assert_allclose(points, [[10 * 1.3 / 1.5, 0]], rtol=1e-6)
    assert not hit.any()


def test_beams_upwards_leave_the_band_at_its_top():
    points, hit, _ = planned([[10, 0, 4.5]])  # 1.8 m after a tenth of the way
    np.testing.assert_allclose(points, [[1, 0]], rtol=1e-6)
    assert not hit.any()


def test_a_sensor_above_the_band_sees_into_it():
    # the band then reaches up to the sensor: what stands in between is not in the way
    points, hit, _ = planned([[4, 0, 1.7], [0, 4, 1.9]], sensor=2.5)
    assert hit.tolist() == [True, False]
    np.testing.assert_allclose(points, [[4, 0], [0, 4]], rtol=1e-6)


def test_of_free_beams_in_one_direction_the_longest_is_kept():
    points, hit, beam = planned([[4, 0, 0.0], [8, 0, 0.0], [6, 0, 0.0]])
    assert beam.tolist() == [1]
    assert not hit.any()
    assert points[0, 0] == pytest.approx(8 * 1.3 / 1.5)


def test_of_hits_in_one_column_the_first_is_kept():
    _, hit, beam = planned([[4.02, 0, 0.5], [4.04, 0, 0.9], [6.02, 0, 0.9]])
    assert beam.tolist() == [0, 2]
    assert hit.all()


def test_beams_without_return_tell_nothing_unless_they_are_believed():
    ends, hit = [[5, 0, 1.0], [0, 8, 1.5]], [True, False]
    assert planned(ends, hit)[2].tolist() == [0]
    points, found, beam = planned(ends, hit, open_space=True)
    assert beam.tolist() == [0, 1]
    assert found.tolist() == [True, False]
    np.testing.assert_allclose(points[1], [0, 8], atol=1e-6)


def test_unusable_beams_are_left_out():
    assert planned([[np.nan, 0, 0], [3, 0, 1.0]])[2].tolist() == [1]


def test_a_column_is_as_occupied_as_what_is_surest_in_the_band():
    cells = np.array([[3, 4, 0], [3, 4, 5], [3, 4, 9], [3, 4, 30], [7, 7, 1]])
    p = np.array([1.0, 0.3, 0.6, 1.0, 1.0], np.float32)
    known = em.CellProbabilities(cells, p, 0.2)
    # middles lie .05, .55, .95, 3.05 and .15 m above the ground
    found = project_cells(known, flat_ground(), BAND, 0.1)
    assert found.cells.tolist() == [[3, 4]]
    assert found.p_occupied.tolist() == [pytest.approx(0.6)]
    assert found.free_prior == 0.2
