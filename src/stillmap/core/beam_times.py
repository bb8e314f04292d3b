"""When the beams of a recording were taken."""

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.recording import Recording


def beam_stamps_ns(recording: Recording, scans: slice) -> NDArray[np.int64]:
    """(n,) stamp in nanoseconds of each beam of a slice of scans."""
    offset = recording.offset[scans.start : scans.stop + 1]
    stamps = np.repeat(recording.stamp_ns[scans], np.diff(offset))
    if recording.beam_time is None:
        return stamps
    seconds = recording.beam_time[offset[0] : offset[-1]].astype(np.float64)
    return np.asarray(stamps + np.round(1e9 * seconds).astype(np.int64))


def max_scan_duration_ns(recording: Recording) -> int:
    """Maximum time in nanoseconds from the stamp of a scan to its beams.

    Without beam times the median time between stamps (of all sensors, which may be interleaved).
    """
    steps, times = np.diff(recording.stamp_ns), recording.beam_time
    longest = float(np.median(steps)) if len(steps) else 0.0
    if times is not None:
        for block in arrays.iter_blocks(times):
            longest = max(longest, 1e9 * float(np.abs(times[block]).max()))
    return int(np.ceil(longest))
