"""Folders of PCD files, one scan each, and single PCD files."""

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap import se2
from stillmap.errors import InputError
from stillmap.output.atomic import new_folder
from stillmap.recording.clouds import pcd_file
from stillmap.recording.clouds.assembling import Cloud, Known, Source, assembled
from stillmap.recording.clouds.files import files_in, stamps_in, stem_of
from stillmap.recording.clouds.origin import Origin
from stillmap.recording.clouds.placing import hits_of, one_sensor, sensor_poses
from stillmap.recording.clouds.point_times import column_of
from stillmap.recording.clouds.rigid import quaternion
from stillmap.recording.lines import Progress
from stillmap.recording.model import Recording
from stillmap.recording.options import ReadOptions

ENDINGS = (".pcd",)

MARK = "*.pcd"  # every such folder has one
_FAR_ENOUGH = 5.0  # m from the origin: a viewpoint there tells in whose frame points are


def read(
    path: Path,
    options: ReadOptions,
    progress: Progress | None = None,
    scratch: Path | None = None,
) -> Recording:
    """Read one PCD file or a folder of them.

    VIEWPOINT is where the scan was taken from: `T_recorded_base`. Points are the sensor's; where
    they lie around the viewpoints instead, they are taken back from there.

    Raises:
        InputError: no scan can be read.
    """
    files = [path] if path.is_file() else files_in(path, ENDINGS)
    stamps = stamps_in([stem_of(file.name, ENDINGS) for file in files])
    known = Known(path, "PCD", [], single=path.is_file())
    in_world = _lie_around_viewpoints(files)
    if in_world:
        known.warnings.append("points lie around their VIEWPOINT: taken back to the sensor's frame")
    origin = Origin()
    sources = [
        Source(file.name, partial(_cloud, file, in_world, origin), stamps[i] if stamps else None)
        for i, file in enumerate(files)
    ]
    recording = assembled(sources, known, options, progress, scratch)
    if notes := origin.notes():
        recording.source.update(notes)
        recording.source["warnings"] += origin.warnings()
    return recording


def _cloud(path: Path, in_world: bool, origin: Origin) -> Cloud:
    head = pcd_file.header(path)
    time = column_of(field.name for field in head.layout.fields)
    found = pcd_file.values(head, ["x", "y", "z", *([time] if time else [])])
    points = np.stack(found[:3], axis=1)
    if head.T is None or np.array_equal(head.T, np.eye(4)):
        points = origin.moved(points)
    elif in_world:
        T = se2.inverse(head.T)
        points = points.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    return Cloud(points, head.T, found[3] if time else None)


def _lie_around_viewpoints(files: list[Path]) -> bool:
    """Whether points are in the frame of the viewpoints, as some programs write them.

    The scan whose viewpoint is farthest from the origin tells: a scan lies around its sensor.
    """
    farthest, at = None, _FAR_ENOUGH
    for file in files:
        try:
            T = pcd_file.header(file).T
        except (InputError, OSError):
            continue
        distance = 0.0 if T is None else float(np.linalg.norm(T[:3, 3]))
        if distance > at:
            farthest, at = file, distance
    if farthest is None:
        return False
    try:
        cloud = _cloud(farthest, False, Origin())
    except (InputError, OSError, MemoryError):
        return False
    points = cloud.points[np.isfinite(cloud.points).all(axis=1)].astype(np.float64)
    if not len(points) or cloud.T is None:
        return False
    from_origin = np.median(np.linalg.norm(points, axis=1))
    from_viewpoint = np.median(np.linalg.norm(points - cloud.T[:3, 3], axis=1))
    return bool(from_viewpoint < from_origin)


def write(recording: Recording, path: str | Path, *, overwrite: bool = False) -> None:
    """Write a folder of binary PCD files: the hits of each scan in the sensor's frame.

    Names are stamps in nanoseconds, with `_1` and so on where one repeats. VIEWPOINT is the
    recorded pose of the sensor; `time` is when a beam was taken, in seconds after the stamp.

    Raises:
        InputError: `path` is taken or cannot be written to, or there are several sensors.
    """
    one_sensor(recording, str(path))
    T = sensor_poses(recording, recording.T_recorded_base)
    with new_folder(Path(path), MARK, overwrite) as folder:
        repeats = 0
        for scan in recording.in_turn(range(recording.n_scans)):
            stamp = int(recording.stamp_ns[scan])
            before = scan > 0 and stamp == recording.stamp_ns[scan - 1]
            repeats = repeats + 1 if before else 0
            name = f"{stamp:0{20 if stamp < 0 else 19}d}" + (f"_{repeats}" if repeats else "")
            pose = np.eye(4) if T is None else T[scan]
            (folder / f"{name}.pcd").write_bytes(_file(recording, scan, pose))


def _file(recording: Recording, scan: int, T: NDArray[np.float64]) -> bytes:
    points, times = hits_of(recording, scan)
    rows = points if times is None else np.column_stack([points, times])
    names = ["x", "y", "z", "time"][: rows.shape[1]]
    viewpoint = " ".join(f"{value:.17g}" for value in (*T[:3, 3], *quaternion(T)))
    header = (
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join('4' for _ in names)}",
        f"TYPE {' '.join('F' for _ in names)}",
        f"COUNT {' '.join('1' for _ in names)}",
        f"WIDTH {len(rows)}",
        "HEIGHT 1",
        f"VIEWPOINT {viewpoint}",
        f"POINTS {len(rows)}",
        "DATA binary",
    )
    return "".join(f"{line}\n" for line in header).encode() + rows.astype("<f4").tobytes()
