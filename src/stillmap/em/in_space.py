"""The E-step in 3D: the default one, to which what came to stay, or left, is dynamic as well.

A recording of streets lasts for minutes, and a car that waits at a light for half of them, then
goes on, is no wall. Whoever removes what moves from a cloud wants the car out, and its place free.
"""

from dataclasses import replace

from stillmap.em.changed import changed_of
from stillmap.em.courses import courses_of, watch
from stillmap.em.dwell import e_step, expectations_of
from stillmap.em.expectations import Expectations
from stillmap.em.looks import Classes, Dwell, Float, looked_at
from stillmap.em.options import EmOptions
from stillmap.recording.model import Recording

_CLASSES = Classes(mover_seconds=(0.5, 3.0, 6.0, 12.0), often_seconds=(8.0, 24.0))


def e_step_in_space(
    recording: Recording, poses: Float, resolution: float, options: EmOptions, threads: int = 1
) -> Expectations:
    """P(c = 1) of every beam: of its end cell being occupied by something that was never away.

    Args: see `dwell.e_step`. Without `changes.enabled` it is that one.
    """
    if not options.changes.enabled:
        return e_step(recording, poses, resolution, options, threads)

    def prepare(dwell: Dwell) -> None:
        watch(dwell, recording, options)

    looks = looked_at(recording, poses, resolution, options, threads, _CLASSES, prepare)
    courses = courses_of(looks, options)
    found = expectations_of(
        looks, looks.under(), recording, poses, options, threads, courses.p_static
    )
    learned = {**found.learned, "changing": round(courses.share, 6)}
    return replace(found, learned=learned, changed=changed_of(courses))
