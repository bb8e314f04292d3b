"""The last E-step, at the poses that are kept: labels, and things that came to stay or left.

It knows more classes than the loop does, and each of the two questions has its own ones of them.
In the loop, what is met from some places only would explain walls that are drawn twice, and hold
the scans to them.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillmap.em.courses import Courses, courses_of, watch
from stillmap.em.dwell import expectations_of
from stillmap.em.expectations import Expectations
from stillmap.em.looks import OFTEN_OCCUPIED, Classes, Dwell, Float, Looks, looked_at
from stillmap.em.options import EmOptions
from stillmap.recording.model import Recording

_CROWDED = 0.15  # share of the time in which somebody is where many pass
_SECONDS = 3.0
_WAITING = 6.0  # s, of no use for labels
_CLASSES = Classes(
    views_occupied=(0.65,),
    mover_occupied=(0.01, 0.04, _CROWDED),
    mover_seconds=(0.5, _SECONDS, _WAITING, 12.0, 45.0),
    often_seconds=(8.0, 24.0),
)


def last_e_step(
    recording: Recording, poses: Float, resolution: float, options: EmOptions, threads: int = 1
) -> tuple[Expectations | None, Courses | None]:
    """Labels with what is met from some places only, and what became of each cell.

    Args: see `dwell.e_step`.

    Returns:
        what is static, None without `dwell.views`; the courses of the same cells, None without
        `changes.enabled`.
    """

    def prepare(dwell: Dwell) -> None:
        if options.changes.enabled:
            watch(dwell, recording, options)

    views = options.dwell.views
    classes = _CLASSES if views else replace(_CLASSES, views_occupied=())
    looks = looked_at(recording, poses, resolution, options, threads, classes, prepare)
    found = None
    if views:
        found = expectations_of(looks, _for_labels(looks), recording, poses, options, threads)
    return found, courses_of(looks, options) if options.changes.enabled else None


def _for_labels(looks: Looks) -> NDArray[np.bool_]:
    """(C,) without crowds of some seconds: these are what a chair is that a robot passes."""
    crowds = (looks.rho == _CROWDED) & (looks.tau == _SECONDS)
    kept = ~crowds & (looks.tau != _WAITING) & (looks.rho != OFTEN_OCCUPIED)
    kept[: looks.n_static] = True
    return np.asarray(kept)
