"""`static.ply` and `dynamic.ply` of a place in 3D: the points of its keyframes."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.places.keyframes import join_keyframes
from stillmap.places.place import PlacedSession
from stillmap.places.shown_state import ShownState
from stillmap.places.writer import PlaceResult
from stillmap.results.points import write_clouds

Float = NDArray[np.float64]


def write_place_clouds(folder: Path, result: PlaceResult) -> None:
    """Write the clouds of all sessions, with labels by what all of them saw."""
    sessions = result.place.sessions
    joined = join_keyframes([one.session.keyframes for one in sessions])
    poses = np.concatenate([one.keyframe_poses for one in sessions])
    labels = np.concatenate([_label_keyframes(one, result.shown) for one in sessions])
    write_clouds(folder, joined.recording, result.place.local_frame.to_map(poses), labels)


def _label_keyframes(one: PlacedSession, shown: ShownState) -> NDArray[np.float32]:
    """(M,) P(static) of the beams of a session's keyframes, as the map shows the place."""
    keyframes = one.session.keyframes
    beams = np.flatnonzero(keyframes.recording.hit)
    ends = keyframes.recording.end_points(beams, one.keyframe_poses)
    # look_up gives 0 where nothing ever stood clearly: those beams keep their own label
    p_gone = shown.place.look_up(ends, 1.0 - shown.p_shown)
    labels = np.array(keyframes.e)
    labels[beams] *= (1.0 - p_gone).astype(np.float32)
    return labels
