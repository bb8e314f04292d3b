"""Summary statistics of a recording, for `stillmap info`."""

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays, se2
from stillmap.core.array_types import Float, Float32, Index, Int64
from stillmap.core.json import to_jsonable
from stillmap.core.recording import Recording
from stillmap.core.source import SensorNotes

_MAX_SAMPLE = 1 << 24  # beams used for quantiles of ranges
_NOTES = (
    *("path", "format", "base_frame", "base_frame_how", "skipped_unit", "skipped"),
    *("skipped_odometry", "damage", "records", "ignored", "params", "read_options"),
    *("duplicates", "warnings", "topics", "self_filter"),
)
_SENSOR_NOTES = (
    *("name", "beams_per_scan", "start_angle", "angle_step", "ranges"),
    *("upside_down", "upside_down_how", "frame"),
)


def summarize_recording(recording: Recording) -> dict[str, Any]:
    """Summarize a recording for `stillmap info`, JSON-able, in metres, seconds and degrees."""
    source = recording.source
    has_times = recording.beam_time is not None and recording.n_beams > 0
    notes = to_jsonable(asdict(source))
    return {
        "dimension": recording.dimension,
        "scans": recording.n_scans,
        "beams": recording.n_beams,
        "beams_per_scan": _quantiles(np.diff(recording.offset), ("min", "median", "max")),
        "counts": _count_beams(recording),
        "hit_ranges_m": _quantiles(_sample_hit_ranges(recording), ("min", "median", "p99", "max")),
        "time": _summarize_time(recording.stamp_ns),
        "part": to_jsonable(source.to_dict().get("part") or {}),
        "beam_times_s": list(recording.beam_time_span) if has_times else None,
        "spin": None if source.spin is None else source.spin.direction,
        "odometry": _summarize_odometry(recording, source.odometry),
        "recorded_poses": _summarize_path(recording.T_recorded_base),
        "images": _summarize_images(recording),
        "sensors": _summarize_sensors(recording),
        **{key: notes[key] for key in _NOTES},
    }


def _sample_hit_ranges(recording: Recording) -> Float32:
    """Ranges of the hits, m; of a sample of them in huge recordings."""
    sample, parts = arrays.sample_indices(recording.n_beams, _MAX_SAMPLE), [np.empty(0, "f4")]
    for part in arrays.split_by_block(sample, arrays.BLOCK):
        beams = sample[part]
        points = recording.points[beams[recording.hit[beams]]]
        parts.append(np.linalg.norm(points.astype(np.float64), axis=1).astype(np.float32))
        recording.release_pages()
    return np.concatenate(parts)


def _quantiles(values: NDArray[Any], wanted: tuple[str, ...]) -> dict[str, float] | None:
    """Quantiles by name; values that occur, so that 81.83 stays 81.83."""
    if values.size == 0:
        return None
    share = {"min": 0.0, "median": 0.5, "p99": 0.99, "max": 1.0}
    found = np.quantile(values, [share[name] for name in wanted], method="lower")
    return {name: round(float(value), 4) for name, value in zip(wanted, found, strict=True)}


def _count_beams(recording: Recording) -> dict[str, Any]:
    hits = unusable = 0
    for block in arrays.iter_blocks(recording.points, recording.hit):
        hits += int(np.count_nonzero(recording.hit[block]))
        unusable += int(np.count_nonzero(np.isnan(recording.points[block]).any(axis=1)))
    max_range = recording.n_beams - hits - unusable
    counts = {"hits": hits, "max_range": max_range, "unusable": unusable}
    total = max(recording.n_beams, 1)
    return {**counts, "shares": {name: count / total for name, count in counts.items()}}


def _summarize_time(stamp_ns: Int64) -> dict[str, Any] | None:
    if len(stamp_ns) == 0:
        return None
    first, last = int(stamp_ns[0]), int(stamp_ns[-1])
    duration = (last - first) / 1e9
    gaps = np.diff(stamp_ns)
    return {
        "first_stamp_ns": first,
        "last_stamp_ns": last,
        "duration_s": duration,
        "rate_hz": len(gaps) / duration if duration > 0 else None,
        "largest_gap_s": float(gaps.max()) / 1e9 if len(gaps) else None,
    }


def _summarize_odometry(recording: Recording, noted: dict[str, Any]) -> dict[str, Any] | None:
    T = recording.T_odom_base
    if T is None:
        return None
    metres, degrees = _step_lengths(T)
    return {
        **{key: noted[key] for key in ("from", "outside") if noted.get(key) is not None},
        **(_summarize_path(T) or {}),
        "largest_step_m": float(metres.max(initial=0.0)),
        "largest_step_deg": float(degrees.max(initial=0.0)),
        "largest_step_at_ns": int(recording.stamp_ns[metres.argmax()]) if len(metres) else None,
    }


def _step_lengths(T: Float) -> tuple[Float, Float]:
    """(T-1,) distances, m, and rotations, degrees, between consecutive poses."""
    step = se2.increments(T)
    # the angle of a rotation in any dimension follows from its trace
    trace = np.trace(step[:, :-1, :-1], axis1=1, axis2=2)
    cosine = trace / 2.0 if T.shape[-1] == 3 else (trace - 1.0) / 2.0
    metres = np.linalg.norm(step[:, :-1, -1], axis=1)
    return metres, np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _summarize_path(T: Float | None) -> dict[str, Any] | None:
    if T is None:
        return None
    metres, degrees = _step_lengths(T)
    return {"path_length_m": float(metres.sum()), "turned_deg": float(degrees.sum())}


def _summarize_images(recording: Recording) -> dict[str, Any] | None:
    images = recording.images
    if images is None:
        return None
    from stillmap.mesh.views import usable_images  # takes long to load

    used, left_out = usable_images(recording)
    return {
        "count": len(images),
        "usable": int(used.sum()),
        "left_out": left_out,
        "cameras": [
            {
                "name": camera.name,
                "count": int(np.sum(images.camera == number)),
                "usable": int(used[images.camera == number].sum()),
                "width": camera.width,
                "height": camera.height,
                "calibrated": camera.K is not None,
                "placed": camera.T_base_camera is not None,
            }
            for number, camera in enumerate(images.cameras)
        ],
    }


def _summarize_sensors(recording: Recording) -> list[dict[str, Any]]:
    """Summaries of all sensors; a moving sensor has several extrinsics and one note."""
    out: list[dict[str, Any]] = []
    noted, first = recording.source.sensors, 0
    while first < len(recording.T_base_sensor):
        notes = noted[len(out)] if len(out) < len(noted) else SensorNotes()
        stop = first + max(notes.places, 1)
        out.append(_summarize_sensor(recording, range(first, stop), notes))
        first = stop
    return out


def _summarize_sensor(recording: Recording, numbers: range, noted: SensorNotes) -> dict[str, Any]:
    """Summarize one sensor from the notes of its reader, else from the arrays."""
    of_sensor = (recording.sensor >= numbers.start) & (recording.sensor < numbers.stop)
    scans = np.flatnonzero(of_sensor)
    out: dict[str, Any] = {"scans": len(scans)}
    known = {key: value for key, value in asdict(noted).items() if value is not None}
    out.update((key, known[key]) for key in _SENSOR_NOTES if key in known)
    if recording.dimension == 2:
        x, y, theta = (float(v) for v in se2.parameters(recording.T_base_sensor[numbers.start]))
        how = "as recorded" if noted.extrinsics is None else noted.extrinsics.how
        out["extrinsics"] = {"x": x, "y": y, "theta_deg": float(np.degrees(theta)), "how": how}
        out["field_of_view_deg"] = _field_of_view(recording, scans, noted)
    return out


def _field_of_view(recording: Recording, scans: Index, noted: SensorNotes) -> list[float] | None:
    """First and last beam angle, degrees: as noted, else the extremes of all usable beams."""
    first, step, n = noted.start_angle, noted.angle_step, noted.beams_per_scan
    if first is not None and step is not None and n is not None:
        last = first + (n - 1) * step
        lowest, highest = sorted([first, last])  # a laser upside down turns clockwise
        return [float(np.degrees(lowest)), float(np.degrees(highest))]
    angles = np.array([np.inf, -np.inf])
    for scan in recording.iter_scans(scans.tolist()):
        points = recording.points[recording.beams_of(scan)]
        angle = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
        angle = angle[np.isfinite(angle)]
        angles[0] = angle.min(initial=angles[0])
        angles[1] = angle.max(initial=angles[1])
    return angles.tolist() if angles[0] <= angles[1] else None
