"""The beams that end in the boxes around people."""

import numpy as np
from numpy.typing import NDArray

from stillmap.em.tracker.changes import changed
from stillmap.em.tracker.features import features
from stillmap.em.tracker.options import TrackerOptions
from stillmap.em.tracker.tracks import Places, people
from stillmap.recording.model import Recording
from stillmap.recording.spool import blocks

Float = NDArray[np.float64]


def on_people(recording: Recording, poses: Float, options: TrackerOptions) -> NDArray[np.bool_]:
    """(M,) which hits lie in the box of somebody who is tracked.

    Args:
        recording: 2D.
        poses: (T, 3, 3) T_map_base.
        options: see TrackerOptions.
    """
    T_map_sensor = recording.T_map_sensor(poses)
    seconds = np.asarray(1e-9 * (recording.stamp_ns - recording.stamp_ns[:1]), np.float64)
    found = features(recording, T_map_sensor, options)
    moving = changed(recording, T_map_sensor, found, options.look, options.jump)
    somebody = people(found, moving, seconds, options)
    return in_boxes(recording, T_map_sensor, somebody, options.box)


def in_boxes(
    recording: Recording, T_map_sensor: Float, somebody: Places, half: float
) -> NDArray[np.bool_]:
    """(M,) which hits lie in boxes, along the axes of the map, `half` m to each side of people."""
    inside = recording.per_beam(np.bool_)
    for block in blocks(inside):
        inside[block] = False
    scans, first = np.unique(somebody.scan, return_index=True)
    bounds = np.append(first, len(somebody.scan))
    for n, t in enumerate(recording.in_turn(scans.tolist(), inside)):
        begin, end = bounds[n : n + 2]
        beams = recording.beams_of(t)
        T = T_map_sensor[t]
        xy = (T[:2, :2] * recording.points[beams][:, None]).sum(axis=-1) + T[:2, 2]
        away = np.abs(xy[:, None] - somebody.xy[begin:end]).max(axis=-1)
        inside[beams] = (away <= half).any(axis=1) & recording.hit[beams]
    return inside
