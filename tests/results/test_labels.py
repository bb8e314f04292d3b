import numpy as np
import pytest

from stillmap.results.writer import write_labels


def test_arrays_can_be_mapped_and_hold_the_labels(tmp_path, result):
    write_labels(tmp_path / "beams", result.recording, result.p_static)
    read = {
        path.stem: np.load(path, mmap_mode="r", allow_pickle=False)
        for path in (tmp_path / "beams").iterdir()
    }
    assert {name: array.dtype for name, array in read.items()} == {
        "stamp_ns": np.dtype(np.int64),
        "offset": np.dtype(np.int64),
        "p_static": np.dtype(np.float32),
        "hit": np.dtype(bool),
    }
    assert all(isinstance(array, np.memmap) for array in read.values())
    np.testing.assert_array_equal(read["stamp_ns"], result.recording.stamp_ns)
    np.testing.assert_array_equal(read["offset"], result.recording.offset)
    np.testing.assert_array_equal(read["hit"], result.recording.hit)
    np.testing.assert_array_equal(read["p_static"], result.p_static)
    unusable = np.isnan(result.recording.points).any(axis=1)
    np.testing.assert_array_equal(np.isnan(read["p_static"]), unusable)


def test_labels_of_another_recording_are_refused(tmp_path, result):
    with pytest.raises(ValueError, match="p_static"):
        write_labels(tmp_path / "beams", result.recording, result.p_static[1:])
