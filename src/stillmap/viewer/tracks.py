"""Poses, boxes and facts of moving objects at a time."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stillmap.results.object_poses import ObjectPoses, is_present
from stillmap.results.reader import Track

Float = NDArray[np.float64]

# corners of a box that each edge joins; bits 0 to 2 of a corner are its side in x, y, z
_EDGES = np.array([(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit])
_FLOOR = _EDGES[(_EDGES < 4).all(axis=1)]


def box_edges(objects: ObjectPoses) -> Float:
    """Both ends of the box edges, (n, 12, 2, 3) m in the map frame; (n, 4, 2, 3) in 2D."""
    edges = _EDGES if objects.size[:, 2].any() else _FLOOR
    sides = ((np.arange(8)[:, None] >> np.arange(3)) & 1) - 0.5  # (8, 3)
    corners = sides * objects.size[:, None]
    R, t = objects.T_map_object[:, :3, :3], objects.T_map_object[:, :3, 3]
    return np.asarray((corners @ R.transpose(0, 2, 1) + t[:, None])[:, edges])


def track_segments(tracks: Sequence[Track]) -> tuple[Float, NDArray[np.intp]]:
    """Line segments (m, 2, 3) in m of all tracks, and the index (m,) of their tracks."""
    lines = [
        np.column_stack([one.xy, np.zeros(len(one.xy)) if one.z is None else one.z])
        for one in tracks
    ]
    segments = [np.stack([row[:-1], row[1:]], axis=1) for row in lines]
    index = np.repeat(np.arange(len(lines)), [len(one) for one in segments])
    return np.concatenate([np.zeros((0, 2, 3)), *segments]), index


def describe_object(track: Track, stamp_ns: int, start_ns: int) -> list[tuple[str, str]]:
    """Names and values of what is known about an object, for a person to read.

    Args:
        track: of the object.
        stamp_ns: the time that is shown.
        start_ns: stamp of the first scan; times are in s since then.
    """
    first, last = (1e-9 * int(track.stamp_ns[n] - start_ns) for n in (0, -1))
    speed = np.linalg.norm(track.velocity, axis=1)
    now = "not seen"
    if is_present(track, stamp_ns):
        at = np.interp(0.0, 1e-9 * (track.stamp_ns - stamp_ns), speed)
        now = f"{at:.1f} m/s"
    facts = [
        ("Seen", f"{first:.1f} s to {last:.1f} s ({last - first:.1f} s)"),
        ("Scans", f"{len(track.stamp_ns)}"),
        ("Speed now", now),
        ("Mean, highest", f"{speed.mean():.1f}, {speed.max():.1f} m/s"),
        ("Size", " x ".join(f"{length:.2f}" for length in track.size) + " m"),
    ]
    if track.beams is not None:
        facts.append(("Beams", f"{track.beams:,}"))
    if track.p_dynamic is not None:
        facts.append(("Mean P(dynamic)", f"{track.p_dynamic:.3f}"))
    if track.p_identity is not None:
        facts.append(("P(one mover)", f"{track.p_identity:.3f}"))
    return facts
