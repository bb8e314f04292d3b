"""Write a result as a `.rrd` file for rerun: map, path, scans with labels, moving objects."""

import os
import threading
import uuid
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import import_extra
from stillmap.core.files import atomic_file
from stillmap.core.local_frame import LocalFrame
from stillmap.results.colors import BLUE, color_by_height, color_by_id, color_by_p_static
from stillmap.results.folder import Exported
from stillmap.results.object_poses import interpolate_pose, iter_present_tracks
from stillmap.results.point_cloud import cloud_from_recording
from stillmap.results.report.figures import draw_map, map_window

_MAX_POINTS = 1_000_000  # of the static cloud
_CLOCK_FROM_NS = 10**17  # stamps from here on (1973) are shown as dates, earlier ones as seconds
_GROUND = 0.02  # m of the map below the floor, so that points on the floor are visible
_HEIGHT, _MIN_SIZE = 0.5, 0.1  # m, of the boxes: height in 2D, least edge
_BATCH = 1 << 20  # beams held in memory until they are written
_PIPE_BLOCK = 1 << 20  # bytes
_NEVER = timedelta(days=1000)

Progress = Callable[[float], None]
Float = NDArray[np.float64]


def require_rerun(path: Path) -> Any:
    """Import rerun.

    Raises:
        MissingExtra: it is not installed.
    """
    return import_extra("rerun", path, "written", group="rerun")


def write(result: Exported, path: Path, progress: Progress | None = None) -> None:
    """Write a result scan by scan: memory is that of a few scans.

    Entities below `map`: `plan`, an image of the map on the floor; in 3D `static_points`, a sample;
    `path`; `base` with a scan of each sensor, coloured from orange (dynamic) to blue (static) and
    with `p_static`; `objects`, a box with a number for each moving object. Timelines are `stamp`
    and `scan`. Where the map frame begins far away, all is relative to `origin` of `map`: rerun has
    coordinates of 32 bits. rerun gives rows and chunks ids by the time of writing: two files of the
    same result hold the same data, but are not equal byte by byte.

    Args:
        result: recording, poses, labels, map and tracks.
        path: the file, written atomically.
        progress: called with the share of the scans that is written.

    Raises:
        InputError: rerun is missing, or the file cannot be written.
    """
    rerun = require_rerun(path)
    with atomic_file(path) as work, work.open("wb") as file:
        pipe = _Pipe(file)
        frame = LocalFrame.near(result.poses)
        stream = _make_stream(rerun, result)
        try:
            view = rerun.blueprint.Spatial3DView(origin="/map", name="stillmap")
            blueprint = rerun.blueprint.Blueprint(view, collapse_panels=True)
            stream.save(pipe.name, default_blueprint=blueprint)
            pipe.start()
            _Writer(rerun, stream, result.to_local(frame), frame).write(pipe, progress)
        finally:
            stream.disconnect()
            pipe.finish()
        pipe.check()


class _Pipe:
    """A pipe into a file: rerun hangs on a file that cannot be written, as on a full disk.

    Attributes:
        name: of the end to write to.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._error: OSError | None = None
        self._read_end, self._write_end = os.pipe()
        self.name = f"/dev/fd/{self._write_end}"
        self._thread = threading.Thread(target=self._copy, daemon=True)

    def start(self) -> None:
        """Copy what the process that opened the other end writes, until it closes it."""
        os.close(self._write_end)
        self._thread.start()

    def _copy(self) -> None:
        with open(self._read_end, "rb", buffering=0) as pipe:
            while block := pipe.read(_PIPE_BLOCK):
                try:
                    if self._error is None:
                        self._file.write(block)
                except OSError as error:
                    self._error = error  # and read on

    def check(self) -> None:
        """Raise the OSError of the file, if there was one."""
        if self._error is not None:
            raise self._error

    def finish(self) -> None:
        """Wait until all is written, after the other end was closed; or close an unused pipe."""
        if self._thread.ident is not None:
            self._thread.join()
            return
        for end in (self._read_end, self._write_end):
            os.close(end)


def _make_stream(rerun: Any, result: Exported) -> Any:
    """A stream with an id of the recording alone, without the time of writing."""
    stamp_ns = result.recording.stamp_ns
    name = uuid.uuid5(uuid.NAMESPACE_URL, f"stillmap {stamp_ns[0]} {stamp_ns[-1]} {len(stamp_ns)}")
    batches = rerun.ChunkBatcherConfig.DEFAULT()
    batches.flush_tick = _NEVER  # by size alone: by the time of writing, contents would differ
    stream = rerun.RecordingStream(
        "stillmap", recording_id=name, send_properties=False, batcher_config=batches
    )
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    return stream


class _Writer:
    """Writes the entities of a result to a stream."""

    def __init__(self, rerun: Any, stream: Any, result: Exported, frame: LocalFrame) -> None:
        self._rerun, self._stream, self._result, self._frame = rerun, stream, result, frame
        self._seen = result.deskew()
        lasers = "laser" if self._seen.dimension == 2 else "lidar"
        S = len(self._seen.T_base_sensor)
        self._sensors = [f"map/base/{lasers}{k or ''}" for k in (0, *range(2, S + 1))][:S]

    def write(self, pipe: _Pipe, progress: Progress | None) -> None:
        """Write everything; stop where the file cannot be written."""
        self._write_fixed()
        seen, result = self._seen, self._result
        present, shown = iter_present_tracks(result.tracks, seen.stamp_ns), list[int]()
        release = [one for one in (result.p_static, result.colors) if one is not None]
        for t in seen.iter_scans(range(seen.n_scans), *release):
            self._set_time(t)
            self._log("map/base", self._transform(result.poses[t]))
            self._write_scan(t)
            before, shown = shown, next(present)
            if before or shown:
                self._log("map/objects", self._boxes(shown, int(seen.stamp_ns[t])))
            if seen.offset[t] // _BATCH < seen.offset[t + 1] // _BATCH:
                self._stream.flush()
                pipe.check()
            if progress is not None:
                progress((t + 1) / seen.n_scans)

    def _log(self, entity: str, *what: Any) -> None:
        self._stream.log(entity, *what, strict=True)

    def _set_time(self, t: int) -> None:
        stamp = int(self._seen.stamp_ns[t])
        self._stream.set_time("scan", sequence=t)
        if self._seen.stamp_ns[0] >= _CLOCK_FROM_NS:
            self._stream.set_time("stamp", timestamp=np.datetime64(stamp, "ns"))
        else:
            self._stream.set_time("stamp", duration=np.timedelta64(stamp, "ns"))

    def _write_fixed(self) -> None:
        """Write everything that does not depend on the time."""
        rerun, result = self._rerun, self._result

        def log(entity: str, *what: Any) -> None:
            self._stream.log(entity, *what, static=True, strict=True)

        log("map", rerun.ViewCoordinates.RIGHT_HAND_Z_UP)
        if self._frame.is_shifted:
            log("map", rerun.AnyValues(origin=self._frame.origin))
        if result.map.p_occupied.size:
            log("map/plan", self._plan())
        log("map/path", rerun.LineStrips3D([_positions(result.poses)], colors=[BLUE]))
        for entity, T in zip(self._sensors, self._seen.T_base_sensor, strict=True):
            log(entity, self._transform(T))
        if self._seen.dimension == 3:
            cloud = cloud_from_recording(
                result.recording, self._seen, result.poses, result.p_static, "static", result.colors
            ).sample(_MAX_POINTS)
            colors, z = cloud.colors, cloud.points[:, 2]
            if colors is None:  # not those of the labels, in which the scans appear
                colors = color_by_height(z, *np.quantile(z, [0.02, 0.98])) if len(z) else None
            points = rerun.Points3D(cloud.points, colors=colors, radii=rerun.Radius.ui_points(0.75))
            log("map/static_points", points, self._labels(cloud.p_static))

    def _plan(self) -> Any:
        """The map as a picture on a rectangle."""
        grid = self._result.map
        x0, y0, x1, y1 = window = map_window([grid])
        picture = np.asarray(draw_map(grid, window).convert("RGB"))
        return self._rerun.Mesh3D(
            vertex_positions=[
                (x, y, -_GROUND) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
            ],
            triangle_indices=[(0, 1, 2), (0, 2, 3)],
            vertex_texcoords=[(0, 1), (1, 1), (1, 0), (0, 0)],  # v downwards, as in the picture
            albedo_texture=picture,
        )

    def _write_scan(self, t: int) -> None:
        """The returns of a scan, in the frame of the sensor at its stamp."""
        seen, beams = self._seen, self._seen.beams_of(t)
        hit = np.flatnonzero(seen.hit[beams])
        points = np.zeros((len(hit), 3), np.float32)
        points[:, : seen.dimension] = seen.points[beams][hit]
        p_static = np.asarray(self._result.p_static[beams][hit])
        radius = self._rerun.Radius.ui_points(1.5)
        cloud = self._rerun.Points3D(points, colors=color_by_p_static(p_static), radii=radius)
        self._log(self._sensors[int(seen.sensor[t])], cloud, self._labels(p_static))

    def _labels(self, p_static: NDArray[np.float32]) -> Any:
        """P(static) of the points that are logged with it."""
        import pyarrow  # which rerun needs; an array of NumPy without numbers has no type for it

        return self._rerun.AnyValues(p_static=pyarrow.array(p_static))

    def _boxes(self, present: list[int], stamp_ns: int) -> Any:
        """A box with a number for each of the present objects."""
        tracks = [self._result.tracks[n] for n in present]
        T = np.array([interpolate_pose(one, stamp_ns) for one in tracks]).reshape(-1, 4, 4)
        size = np.array([(*one.size, _HEIGHT)[:3] for one in tracks]).reshape(-1, 3)
        size = np.maximum(size, _MIN_SIZE)
        if self._seen.dimension == 2:
            T[:, 2, 3] = size[:, 2] / 2
        half = np.arctan2(T[:, 1, 0], T[:, 0, 0]) / 2
        zero = np.zeros(len(tracks))
        return self._rerun.Boxes3D(
            centers=T[:, :3, 3],
            sizes=size,
            quaternions=np.stack([zero, zero, np.sin(half), np.cos(half)], axis=1),
            colors=color_by_id([one.id for one in tracks]),
            labels=[str(one.id) for one in tracks],
        )

    def _transform(self, T: Float) -> Any:
        """A Transform3D of a pose (D+1, D+1)."""
        D, R, t = len(T) - 1, np.eye(3), np.zeros(3)
        R[:D, :D], t[:D] = T[:D, :D], T[:D, D]
        return self._rerun.Transform3D(translation=t, mat3x3=R)


def _positions(poses: Float) -> Float:
    """(T, 3) positions of poses (T, D+1, D+1)."""
    D = poses.shape[-1] - 1
    out = np.zeros((len(poses), 3))
    out[:, :D] = poses[:, :D, D]
    return out
