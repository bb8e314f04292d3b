from pathlib import Path

import numpy as np
from people import recording_of


def test_marks_stay_with_their_beams(tmp_path: Path) -> None:
    ranges = np.array([[1.0, 2.0, -np.inf], [4.0, np.inf, 3.0]], np.float32)
    np.savez(
        tmp_path / "people_1.npz",
        ranges=ranges,
        label=np.array([[0, 1, 0], [0, 0, 1]], np.int8),
        t=np.array([10.0, 10.13]),
        angle_min=0.0,
        angle_increment=np.pi / 2,
        range_min=0.03,
        range_max=11.0,
    )
    recording, leg = recording_of(tmp_path / "people_1.npz")
    assert recording.hit.tolist() == [True, True, False, True, False, True]
    assert leg.tolist() == [False, True, False, False, False, True]
    np.testing.assert_allclose(recording.points[[1, 5]], [[0, 2], [-3, 0]], atol=1e-6)
    assert np.isnan(recording.points[2]).all()  # nearer than the laser can tell
    assert np.diff(recording.stamp_ns).tolist() == [130_000_000]
