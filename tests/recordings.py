"""Recordings made up by tests."""

from typing import Any

import numpy as np

from stillmap.core.recording import Recording

ARRAYS = (
    *("stamp_ns", "offset", "points", "hit", "T_base_sensor", "sensor"),
    *("T_odom_base", "beam_time", "T_recorded_base"),
)


def require_same_arrays(a: Recording, b: Recording, names: tuple[str, ...] = ARRAYS) -> None:
    """Two recordings have the same numbers of the same types."""
    for name in names:
        one, other = getattr(a, name), getattr(b, name)
        assert (one is None) == (other is None), name
        if one is not None:
            assert one.dtype == other.dtype, name
            np.testing.assert_array_equal(one, other, err_msg=name)


def of_one_sensor(stamp_ns: Any, offset: Any, points: Any, hit: Any, **more: Any) -> Recording:
    """A recording of one sensor in the frame of the robot, without odometry."""
    usual = {
        "T_base_sensor": np.eye(points.shape[1] + 1)[None],
        "sensor": np.zeros(len(stamp_ns), np.int32),
        "T_odom_base": None,
    }
    return Recording(stamp_ns=stamp_ns, offset=offset, points=points, hit=hit, **usual, **more)
