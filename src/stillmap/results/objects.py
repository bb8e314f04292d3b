"""`objects/`: tracked objects as JSON and point clouds; `traffic.npz`; poses along tracks."""

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float, Float32, Int64
from stillmap.core.arrays import write_npz
from stillmap.core.local_frame import FAR
from stillmap.io.point_cloud.ply import make_header
from stillmap.io.point_cloud.table import Fields
from stillmap.io.trajectory import embed_in_3d
from stillmap.pipeline.result import MappingResult
from stillmap.pipeline.tilting import TiltingResult
from stillmap.results.point_cloud import coordinate_fields
from stillmap.results.reader import Track
from stillmap.tracking import FlowMap, MovingObject

Mover = MovingObject | Track

_MIN_SPEED = 0.2  # m/s from which a velocity gives the heading
# of the cloud of an object
OBJECT_FIELDS: Fields = [(name, "<f4") for name in ("x", "y", "z", "seconds", "p_dynamic")]
MILLIMETRES = 3  # digits: finer is noise, and makes the file twice as long


def write_objects(folder: Path, result: MappingResult | TiltingResult) -> None:
    """Write `objects.json` and `NNNN.ply` of each object into a new folder."""
    objects, recording, p_static = result.objects, result.deskewed, result.p_static
    folder.mkdir()
    write_records(folder / "objects.json", map(object_record, objects))
    for one in objects:
        ends = recording.end_points(one.beams, result.poses)
        stamps = recording.stamp_ns[recording.scans_of(one.beams)]
        seconds = 1e-9 * (stamps - one.stamp_ns[0])
        write_ply(folder / f"{one.id:04d}.ply", ends, seconds, 1.0 - p_static[one.beams])
        recording.release_pages(p_static, one.beams)


def write_records(path: Path, records: Iterable[dict[str, Any]]) -> None:
    """Write a list of objects as JSON, one a line."""
    lines = ",\n".join(json.dumps(record, allow_nan=False) for record in records)
    path.write_text(f"[\n{lines}\n]\n" if lines else "[]\n", encoding="utf-8")


def object_record(one: MovingObject) -> dict[str, Any]:
    """One entry of `objects.json`: metres, metres per second, nanoseconds."""
    columns = dict(zip("xy", one.xy.T, strict=True))
    if one.z is not None:
        columns["z"] = one.z
    columns |= zip(("vx", "vy"), one.velocity.T, strict=True)
    return {
        "id": one.id,
        "first_stamp_ns": int(one.stamp_ns[0]),
        "last_stamp_ns": int(one.stamp_ns[-1]),
        "size": [round(metres, MILLIMETRES) for metres in one.size],
        "beams": len(one.beams),
        "p_dynamic": round(one.p_dynamic, 6),
        "p_identity": round(one.p_identity, 6),
        "track": {
            "stamp_ns": one.stamp_ns.tolist(),
            **{name: np.round(values, MILLIMETRES).tolist() for name, values in columns.items()},
        },
    }


def write_ply(path: Path, ends: Float, seconds: Float, p_dynamic: Float32) -> None:
    """Points (n, D) of an object, when each was seen, and how probably it is dynamic; 2D: z = 0.
    Coordinates far from the origin have 64 bits."""
    fields = coordinate_fields(OBJECT_FIELDS, bool(np.abs(ends).max(initial=0.0) > FAR))
    vertices = np.zeros(len(ends), fields)
    for name, column in zip("xyz", ends.T, strict=False):
        vertices[name] = column
    vertices["seconds"], vertices["p_dynamic"] = seconds, p_dynamic
    path.write_bytes(make_header(fields, len(ends)) + vertices.tobytes())


def write_traffic(path: Path, traffic: FlowMap) -> None:
    """Write `crossings`, `speed` (H, W), `origin` (x, y, yaw) and `resolution` in metres."""
    write_npz(
        path,
        {
            "crossings": np.asarray(traffic.crossings, np.int32),
            "speed": np.asarray(traffic.speed, np.float32),
            "origin": np.asarray(traffic.origin, np.float64),
            "resolution": np.asarray(traffic.resolution, np.float64),
        },
    )


def headings(velocity: Float) -> Float:
    """Headings (K,) in rad from velocities (K, 2), interpolated where an object stands."""
    moving = np.flatnonzero(np.linalg.norm(velocity, axis=1) >= _MIN_SPEED)
    if not len(moving):
        return np.zeros(len(velocity))
    angle = np.unwrap(np.arctan2(velocity[moving, 1], velocity[moving, 0]))
    return np.asarray(np.interp(np.arange(len(velocity)), moving, angle))


def interpolate_pose(track: Mover, stamp_ns: int) -> Float:
    """T_map_object (4, 4) at a time, interpolated; constant beyond the ends of the track."""
    # differences first: stamps in ns exceed the precision of float64
    seconds = 1e-9 * (track.stamp_ns - stamp_ns)
    x, y, angle = (np.interp(0.0, seconds, row) for row in (*track.xy.T, headings(track.velocity)))
    T = embed_in_3d(se2.matrix(x, y, angle))
    T[2, 3] = 0.0 if track.z is None else np.interp(0.0, seconds, track.z)
    return T


def iter_present_tracks(tracks: Sequence[Mover], stamp_ns: Int64) -> Iterator[list[int]]:
    """For each of the rising stamps (T,), the indices of the tracks that span it."""
    first = np.searchsorted(stamp_ns, np.array([one.stamp_ns[0] for one in tracks], np.int64))
    last = np.array([one.stamp_ns[-1] for one in tracks], np.int64)
    order = np.argsort(first, kind="stable")
    for t, stamp in enumerate(stamp_ns):
        yield order[(first[order] <= t) & (last[order] >= stamp)].tolist()
