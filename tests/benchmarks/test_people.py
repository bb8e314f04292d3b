from pathlib import Path

import numpy as np
import pytest
from people import recording_of

from stillmap.core.recording import Recording
from stillmap.io import writers


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Two scans of three beams, ahead, to the left and back."""
    directions = np.array([[1, 0], [0, 1], [-1, 0]], np.float32)
    ranges = np.array([[1.0, 2.0, np.nan], [4.0, 11.0, 3.0]], np.float32)
    recording = Recording(
        stamp_ns=np.array([10_000_000_000, 10_130_000_000]),
        offset=np.array([0, 3, 6]),
        points=(ranges[..., None] * directions).reshape(-1, 2),
        hit=np.array([True, True, False, True, False, True]),
        T_base_sensor=np.eye(3)[None],
        sensor=np.zeros(2, np.int32),
        T_odom_base=None,
    )
    writers.write(recording, tmp_path / "people_1.bag")
    return tmp_path / "people_1.bag"


def test_marks_stay_with_their_beams(bag: Path) -> None:
    marks = bag.with_suffix(".npz")
    np.savez(marks, label=np.array([[0, 1, 0], [0, 0, 1]], np.int8))
    recording, leg = recording_of(marks)
    assert recording.hit.tolist() == [True, True, False, True, False, True]
    assert leg.tolist() == [False, True, False, False, False, True]
    np.testing.assert_allclose(recording.points[[1, 5]], [[0, 2], [-3, 0]], atol=1e-6)


def test_marks_of_other_scans_are_refused(bag: Path) -> None:
    marks = bag.with_suffix(".npz")
    np.savez(marks, label=np.zeros((3, 3), np.int8))
    with pytest.raises(SystemExit, match="marks of other scans"):
        recording_of(marks)
