"""Arrays between processes."""

import io

import numpy as np
import pytest

from stillmap.live.loop_process import read_message, write_message


def written(arrays):
    stream = io.BytesIO()
    write_message(stream, arrays)
    return stream.getvalue()


def test_arrays_come_back():
    sent = {"one": np.arange(6.0).reshape(2, 3), "none": np.zeros((0, 2), np.float32)}
    stream = io.BytesIO(written(sent) + written({"two": np.array(7)}))
    first, second = read_message(stream), read_message(stream)
    np.testing.assert_array_equal(first["one"], sent["one"])
    assert first["none"].shape == (0, 2)
    assert second["two"] == 7
    assert read_message(stream) is None


@pytest.mark.parametrize("left", [3, 12, -5])
def test_a_stream_that_ends_amid_a_message_has_ended(left):
    assert read_message(io.BytesIO(written({"one": np.arange(20)})[:left])) is None


def test_a_correction_may_have_thousands_of_scans():
    sent = {f"near.{k}.T_base_sensor": np.eye(3) for k in range(30_000)}
    assert len(read_message(io.BytesIO(written(sent)))) == 30_000
