"""One recording in every form gives the same map, to the rounding of the form."""

import numpy as np
import pytest

from stillmap import build
from stillmap.io import read, writers
from stillmap.prepare.options import ReadOptions

FREE = 6.0  # m: bags and logs only say that nothing came back, not how far away that was


ENDINGS = (".bag", ".db3", ".mcap", ".log", ".clf.gz", "")


@pytest.fixture
def own(room, tmp_path):
    path = tmp_path / "own"
    writers.write(room.recording, path)
    return read(path, ReadOptions(free_range=FREE))


def in_form(recording, folder, ending):
    path = folder / f"form{ending}"
    writers.write(recording, path, name="ros2" if not ending else None)
    again = read(path, ReadOptions(free_range=FREE))
    np.testing.assert_array_equal(again.stamp_ns, recording.stamp_ns)
    np.testing.assert_array_equal(again.hit, recording.hit)
    return again


@pytest.mark.slow
@pytest.mark.parametrize("ending", ENDINGS)
def test_the_same_map_at_given_poses(room, own, tmp_path, ending):
    poses = room.truth.T_world_base
    found = build(in_form(room.recording, tmp_path, ending), poses=poses)
    expected = build(own, poses=poses)
    assert np.nanmean(np.abs(found.p_static - expected.p_static) > 0.01) < 1e-3
    differing, elsewhere = _compared(found.map, expected.map, 0.01)
    assert differing < 2e-3
    assert elsewhere < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("ending", ENDINGS)
def test_the_same_way_and_map(room, own, tmp_path, ending):
    """Where two poses are about as good, the last digit may decide: by less than the noise."""
    found, expected = build(in_form(room.recording, tmp_path, ending)), build(own)
    np.testing.assert_allclose(found.poses, expected.poses, atol=0.01)
    assert np.nanmean(np.abs(found.p_static - expected.p_static) > 0.1) < 5e-3
    differing, elsewhere = _compared(found.map, expected.map, 0.2)
    assert differing < 0.02
    assert elsewhere < 0.01


def _compared(a, b, tolerance):
    """Shares of the cells that two maps know that differ, and of all that one alone knows."""
    one, other = _shared(a, b)
    known = np.isfinite(one) & np.isfinite(other)
    differing = np.mean(np.abs(one - other)[known] > tolerance)
    return differing, np.mean(np.isfinite(one) != np.isfinite(other))


def _shared(a, b):
    """p_occupied of the cells that two maps share."""
    corner = np.round((np.array(b.origin[:2]) - a.origin[:2]) / a.resolution).astype(int)
    first = np.maximum(corner, 0)
    height, width = np.minimum(np.array(a.p_occupied.shape), corner[::-1] + b.p_occupied.shape)
    part_a = a.p_occupied[first[1] : height, first[0] : width]
    at = first - corner
    part_b = b.p_occupied[at[1] : at[1] + part_a.shape[0], at[0] : at[0] + part_a.shape[1]]
    return part_a, part_b
