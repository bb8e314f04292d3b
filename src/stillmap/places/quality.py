"""Quality of a place without truth: do its sessions see the same surfaces in the same places?"""

import numpy as np

from stillmap.em import OccupancyMap
from stillmap.pipeline.quality import Quality, rate_geometry
from stillmap.places.keyframes import join_keyframes
from stillmap.places.place import Place


def rate_place(place: Place, occupancy: OccupancyMap) -> Quality:
    """Rates poses and map of a place from the keyframes of its sessions.

    Labels are not rated: keyframes are too far apart for that.

    Args:
        place: two sessions or more.
        occupancy: its map.
    """
    joined = join_keyframes([one.session.keyframes for one in place.sessions])
    poses = np.concatenate([one.keyframe_poses for one in place.sessions])
    return rate_geometry(joined.recording, poses, occupancy)
