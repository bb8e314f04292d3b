"""When each point of a cloud was taken, from fields that every driver names otherwise."""

import numpy as np
from numpy.typing import NDArray

TIME_FIELDS = ("t", "time", "timestamp", "time_stamp", "offset_time", "timeoffset", "point_time")

_UNITS = (1.0, 1e-3, 1e-6, 1e-9)  # seconds and its thousandths
_LONGEST = 2.0  # s from the first point of a sweep to its last
_SHORTEST = 1e-3
_YEAR_2001 = 1e9  # s: no count within a sweep is so large


def beam_times(values: NDArray[np.generic], stamp_ns: int) -> NDArray[np.float64] | None:
    """Seconds after the stamp at which points were taken; None where the field makes no sense.

    Integers and floating point numbers are in use, in s, ms, us and ns, since the sweep's stamp or
    since 1970. The unit is the largest with which a sweep takes no longer than two seconds.

    Args:
        values: (n,) the field.
        stamp_ns: of the sweep.
    """
    value = values.astype(np.float64)
    good = np.isfinite(value)
    if not good.any():
        return None
    low, high = float(value[good].min()), float(value[good].max())
    span = high - low
    if span == 0.0:
        return None
    unit = next((u for u in _UNITS if span * u <= _LONGEST), None)
    if unit is None or span * unit < _SHORTEST:
        return None
    if low * unit >= _YEAR_2001:  # a time of day: exact nanoseconds as integers where they are
        first = int(values[good].min()) if unit == 1e-9 else round(low * unit * 1e9)
        seconds = (value - low) * unit + (first - stamp_ns) / 1e9
    else:
        seconds = value * unit
    # a clock of its own tells how far apart points are, not how far from the stamp
    if abs(float(np.median(seconds[good]))) > _LONGEST:
        seconds -= float(seconds[good].min())
    return np.where(good, seconds, 0.0)
