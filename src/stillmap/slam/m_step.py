"""The M-step over poses and map. Loop closure will stand between its two lines of work."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stillmap import _core, em
from stillmap.recording.model import Recording
from stillmap.slam import closing, incremental
from stillmap.slam.incremental import Mapped, SlamOptions

Float = NDArray[np.float64]


def m_step(
    recording: Recording,
    e: NDArray[np.float32],
    options: SlamOptions,
    poses: Float | None,
    threads: int,
    progress: Callable[[int, int], None],
) -> Mapped:
    """The most likely poses and map given e: (9), (10)-(15).

    Args:
        recording: 2D.
        e: (M,) probability that each beam was reflected by something static.
        options: see SlamOptions.
        poses: (T, 3, 3) T_map_base when they are known: then only the map is made.
        threads: for the map of known poses.
        progress: called with the number of scans done and their total.
    """
    if poses is None:
        memory = options.loops.memory if options.loops.enabled else np.inf
        mapped = incremental.build(recording, e, options, progress, memory)
        if not options.loops.enabled:
            return mapped
        return closing.closed(recording, e, options, mapped, threads)
    grid = _core.Grid2D(options.resolution, options.registration.approach)
    em.add_recording(grid, recording, poses, e, threads)
    T = recording.n_scans
    progress(T, T)
    return Mapped(poses, np.zeros((T, 3, 3)), grid, np.full(T, np.nan), [])
