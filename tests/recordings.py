"""Recordings made up by tests."""

from typing import Any

import numpy as np

from stillmap.core.recording import Recording


def of_one_sensor(stamp_ns: Any, offset: Any, points: Any, hit: Any, **more: Any) -> Recording:
    """A recording of one sensor in the frame of the robot, without odometry."""
    usual = {
        "T_base_sensor": np.eye(points.shape[1] + 1)[None],
        "sensor": np.zeros(len(stamp_ns), np.int32),
        "T_odom_base": None,
    }
    return Recording(stamp_ns=stamp_ns, offset=offset, points=points, hit=hit, **usual, **more)
