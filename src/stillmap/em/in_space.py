"""The E-step in 3D: the default one, to which what came to stay, or left, is dynamic as well.

A recording of streets lasts for minutes, and a car that waits at a light for half of them, then
goes on, is no wall. Whoever removes what moves from a cloud wants the car out, and its place free.
"""

from dataclasses import replace

from stillmap.em.beside import with_those_beside
from stillmap.em.bodies import feet_of, standing_on, with_bodies
from stillmap.em.changed import changed_of
from stillmap.em.courses import courses_of, told_of, watch
from stillmap.em.dwell import e_step, expectations_of
from stillmap.em.expectations import Expectations
from stillmap.em.ground import ground_under
from stillmap.em.looks import Classes, Dwell, Float, looked_at
from stillmap.em.options import EmOptions
from stillmap.recording.model import Recording

_CLASSES = Classes(mover_seconds=(0.5, 3.0, 6.0, 12.0), often_seconds=(8.0, 24.0))


def e_step_in_space(
    recording: Recording, poses: Float, resolution: float, options: EmOptions, threads: int = 1
) -> Expectations:
    """P(c = 1) of every beam: of its end cell being occupied by something that was never away.

    Args: see `dwell.e_step`. Without `changes.enabled` it is that one. With `changes.in_space`
    it also says where things came or left.
    """
    if not options.changes.enabled:
        return e_step(recording, poses, resolution, options, threads)

    listed = options.changes.in_space

    def prepare(dwell: Dwell) -> None:
        watch(dwell, recording, options, courses=listed)

    looks = looked_at(recording, poses, resolution, options, threads, _CLASSES, prepare)
    told = told_of(looks, options)
    static = with_those_beside(told.p_static, looks.surface, options.beside, threads)
    T_map_sensor = recording.T_map_sensor(poses)
    ground = ground_under(looks.surface, static, T_map_sensor[:, :3, 3])
    standing = standing_on(ground, looks.surface, options.bodies)
    static = with_bodies(
        static, told.change, standing, recording, T_map_sensor, options.bodies, threads
    )
    feet = feet_of(standing, static, options.bodies)
    found = expectations_of(looks, None, recording, poses, options, threads, static, feet)
    return replace(
        found,
        learned={**found.learned, "changing": round(told.share, 6)},
        changed=changed_of(courses_of(looks, options)) if listed else None,
        ground=ground,
    )
