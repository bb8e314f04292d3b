"""What benchmarks/rig.py counts with."""

import numpy as np
import pytest
from rig import kept_and_removed


def test_shares_of_what_is_kept_and_removed():
    p_static = np.array([0.9, 0.2, 0.9, 0.9, 0.1, 0.6], np.float32)
    static = np.array([True, True, True, True, False, False])
    some = np.ones(6, bool)
    assert kept_and_removed(p_static, static, some) == (75.0, 50.0, 60.0)
    some[5] = False
    sa, da, ha = kept_and_removed(p_static, static, some)
    assert (sa, da) == (75.0, 100.0)
    assert ha == pytest.approx(2 / (1 / 75 + 1 / 100))
