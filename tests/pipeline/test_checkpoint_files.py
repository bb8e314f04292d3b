"""Arrays of checkpoints are checked against the types that the state declares."""

import numpy as np
import pytest
from numpy.typing import NDArray

from stillmap.pipeline.checkpoint_files import _array_of


@pytest.mark.parametrize("given", [np.int64, np.longlong])
def test_integers_of_64_bits_are_of_one_type(given):
    array = np.arange(3, dtype=given)
    assert _array_of(NDArray[np.int64], array, "cells") is array


@pytest.mark.parametrize("given", [np.int32, np.float64, np.uint64])
def test_other_types_are_refused(given):
    with pytest.raises(TypeError, match="cells"):
        _array_of(NDArray[np.int64], np.arange(3, dtype=given), "cells")
