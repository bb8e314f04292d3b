"""The public logs, where they are at hand: what is in them is known."""

import numpy as np
import pytest

from stillmap.io import read

LOGS = [
    # scans in the log, beams each, maximum-range code
    ("aces", 440, 180, 50.0),
    ("belgioioso", 395, 361, 81.91),
    ("edmonton", 340, 180, 51.09),
    ("fr101", 292, 360, 81.83),
    ("intel", 4610, 180, 81.83),
    ("seattle", 241, 361, 81.87),
]


@pytest.mark.parametrize(("name", "scans", "beams", "code"), LOGS)
def test_public_log(shared_data, name, scans, beams, code):
    recording = read(shared_data / "laser2d" / f"{name}.clf.gz")
    assert recording.source.skipped == {}
    assert recording.n_scans == scans
    assert set(np.diff(recording.offset)) == {beams}
    (sensor,) = recording.source.sensors
    assert sensor.ranges.threshold == code
    assert sensor.ranges.zero_means == "unusable"
    length = np.linalg.norm(recording.points, axis=1)
    assert length[recording.hit].max() < code
    assert 10.0 < sensor.ranges.free_range < code
    assert np.isfinite(recording.points).all()
    assert recording.T_odom_base is not None
