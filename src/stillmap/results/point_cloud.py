"""The points of a 3D result in the map frame, block by block; `static.ply`, `dynamic.ply`."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.array_types import Bool, Float, Float32, Int64
from stillmap.core.chunks import Chunk, iter_chunks
from stillmap.core.errors import InputError
from stillmap.core.local_frame import FAR
from stillmap.core.recording import Recording, beam_stamps_ns
from stillmap.em.types import DYNAMIC_BELOW
from stillmap.io.point_cloud import ply
from stillmap.io.point_cloud.table import Fields, TableLayout, read_columns
from stillmap.io.trajectory import MAX_TRANSLATION

Part = Literal["static", "dynamic"]

FIELDS: Fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("p_static", "<f4")]
COLOURS: Fields = [("red", "u1"), ("green", "u1"), ("blue", "u1")]
PACKED_COLOUR: Fields = [("rgb", "<u4")]  # 0x00RRGGBB, of PCD
MAX_BLOCK = 1 << 16  # points in memory


class Block(NamedTuple):
    """n points.

    Attributes:
        points: (n, 3) float64 m in the map frame.
        p_static: (n,) float32.
        stamp_ns: (n,) int64; None where unknown.
        colors: (n, 3) uint8; None for a cloud without colors.
    """

    points: Float
    p_static: Float32
    stamp_ns: Int64 | None
    colors: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class Cloud:
    """A point cloud that is produced block by block.

    Attributes:
        count: number of points.
        origin: (3,) whole m near the points.
        start_ns: lower bound of the stamps; None where unknown.
        make_blocks: starts a new iteration.
        has_colors: whether blocks have colors.
    """

    count: int
    origin: Float
    start_ns: int | None
    make_blocks: Callable[[], Iterator[Block]]
    has_colors: bool = False

    @property
    def is_far(self) -> bool:
        """True if float32 coordinates would be off by a millimetre or more."""
        return bool(np.abs(self.origin).max() > FAR)

    def iter_blocks(self, progress: Callable[[float], None] | None = None) -> Iterator[Block]:
        """The points in blocks of at most `MAX_BLOCK`; `progress` is called with the share of them
        that is done."""
        done = 0
        for block in self.make_blocks():
            for first in range(0, len(block.points), MAX_BLOCK):
                part = slice(first, first + MAX_BLOCK)
                columns: list[Any] = [None if one is None else one[part] for one in block]
                yield Block(*columns)
                done += len(columns[0])
                if progress is not None:
                    progress(done / self.count)

    def sample(self, max_count: int) -> Block:
        """At most `max_count` of the points, evenly over their order, without times."""
        use, first = arrays.sample_indices(self.count, max_count), 0
        points, p_static = np.empty((len(use), 3)), np.empty(len(use), np.float32)
        colors = np.empty((len(use), 3), np.uint8) if self.has_colors else None
        for block in self.make_blocks():
            end = first + len(block.points)
            into = slice(*np.searchsorted(use, [first, end]).tolist())
            points[into] = block.points[use[into] - first]
            p_static[into] = block.p_static[use[into] - first]
            if colors is not None and block.colors is not None:
                colors[into] = block.colors[use[into] - first]
            first = end
        return Block(points, p_static, None, colors)


def cloud_from_recording(
    recording: Recording,
    deskewed: Recording,
    poses: Float,
    p_static: Float32,
    only: Part | None = None,
    colors: NDArray[np.uint8] | None = None,
    origin: Float | None = None,
) -> Cloud:
    """All returns, in the order of the recording; memory is that of a few scans.

    Args:
        recording: 3D, T scans with M beams, T >= 1.
        deskewed: the same without the motion during its scans.
        poses: (T, 4, 4) T_map_base.
        p_static: (M,) P(c = 1).
        only: static or dynamic points; None: both.
        colors: (M, 3); None: without.
        origin: (3,) of the frame in which the result was computed; None or zero: that of the map.
    """
    times = recording.beam_time
    T_map_sensor, earliest = deskewed.T_map_sensor(poses), min(recording.beam_time_span[0], 0.0)
    if origin is None or not origin.any():
        origin = np.round(poses[0, :3, 3])

    def make_blocks() -> Iterator[Block]:
        mapped = [one for one in (p_static, times, colors) if one is not None]
        for chunk in iter_chunks(deskewed, release=mapped):
            hits = _select(deskewed.hit[chunk.beams], p_static[chunk.beams], only)
            points = _to_map_frame(deskewed, chunk, hits, T_map_sensor)
            stamp_ns = beam_stamps_ns(recording, chunk.scans)[hits]
            selected = None if colors is None else np.asarray(colors[chunk.beams][hits])
            yield Block(points, np.asarray(p_static[chunk.beams][hits]), stamp_ns, selected)

    count = sum(
        int(np.count_nonzero(_select(deskewed.hit[block], p_static[block], only)))
        for block in arrays.iter_blocks(deskewed.hit, p_static)
    )
    start_ns = int(recording.stamp_ns[0]) + int(np.floor(1e9 * earliest))
    return Cloud(count, origin, start_ns, make_blocks, colors is not None)


def cloud_from_folder(folder: Path, only: Part | None = None) -> Cloud:
    """The points of `static.ply` and `dynamic.ply`, without times.

    Raises:
        InputError: one of them is missing or damaged.
    """
    layouts = [
        ply.read_layout(folder / f"{part}.ply")
        for part in ("static", "dynamic")
        if only in (part, None)
    ]
    colors = {name for name, _ in COLOURS}
    has_colors = all(colors <= set(layout.dtype.names or ()) for layout in layouts)
    wanted = [name for name, _ in FIELDS + (COLOURS if has_colors else [])]

    def make_blocks() -> Iterator[Block]:
        for layout in layouts:
            for values in read_columns(layout, wanted):
                points = np.stack(values[:3], axis=1).astype(np.float64)
                if not (np.abs(points) < MAX_TRANSLATION).all():
                    what = "holds a point that is not finite, or too far away"
                    raise InputError(what, where=str(layout.path))
                p_static = values[3].astype(np.float32)
                if not ((p_static >= 0.0) & (p_static <= 1.0)).all():
                    raise InputError("p_static is no probability", where=str(layout.path))
                colors = np.stack(values[4:], axis=1).astype(np.uint8) if has_colors else None
                yield Block(points, p_static, None, colors)

    count = sum(layout.rows for layout in layouts)
    return Cloud(count, _find_origin(layouts), None, make_blocks, has_colors)


def _find_origin(layouts: Sequence[TableLayout]) -> Float:
    """(3,) whole m near the points of files; zero where they are 32-bit, and so near it."""
    for layout in layouts:
        dtype = layout.dtype
        is_double = all(dtype[axis] == np.float64 for axis in dtype.names or () if axis in "xyz")
        if is_double and layout.rows:
            x, y, z = next(iter(read_columns(layout, ("x", "y", "z"))))
            first = np.array([x[0], y[0], z[0]])
            return np.round(first) if np.isfinite(first).all() else np.zeros(3)
    return np.zeros(3)


def _select(hit: Bool, p_static: Float32, only: Part | None) -> Bool:
    if only is None:
        return np.asarray(hit)
    dynamic = p_static < DYNAMIC_BELOW
    return np.asarray(hit & (dynamic if only == "dynamic" else ~dynamic))


def _to_map_frame(deskewed: Recording, chunk: Chunk, selected: Bool, T_map_sensor: Float) -> Float:
    """Selected end points of a chunk, (n, 3) m in the map frame."""
    out = np.empty((int(np.count_nonzero(selected)), 3))
    done, points = 0, deskewed.points[chunk.beams]
    for n, t in enumerate(range(chunk.scans.start, chunk.scans.stop)):
        beams, T = slice(int(chunk.offset[n]), int(chunk.offset[n + 1])), T_map_sensor[t]
        ends = points[beams][selected[beams]].astype(np.float64)
        out[done : done + len(ends)] = ends @ T[:3, :3].T + T[:3, 3]
        done += len(ends)
    return out


def write_clouds(
    folder: Path,
    seen: Recording,
    poses: Float,
    p_static: Float32,
    colours: NDArray[np.uint8] | None = None,
    origin: Float | None = None,
) -> None:
    """Write every hit to one of the two files; memory is that of a few scans.

    Args:
        folder: where to.
        seen: 3D, M beams without the motion during its scans.
        poses: (T, 4, 4) T_map_base.
        p_static: (M,) P(c = 1); below one half it is dynamic.
        colours: (M, 3), None: without.
        origin: see `cloud_from_recording`.
    """
    dynamic = cloud_from_recording(seen, seen, poses, p_static, "dynamic").count
    cloud = cloud_from_recording(seen, seen, poses, p_static, colors=colours, origin=origin)
    fields = cloud_fields(cloud, COLOURS)
    with (
        (folder / "static.ply").open("wb") as static,
        (folder / "dynamic.ply").open("wb") as moving,
    ):
        static.write(ply.make_header(fields, cloud.count - dynamic))
        moving.write(ply.make_header(fields, dynamic))
        for block in cloud.iter_blocks():
            vertices = make_vertices(block, fields)
            moves = vertices["p_static"] < DYNAMIC_BELOW
            static.write(vertices[~moves].tobytes())
            moving.write(vertices[moves].tobytes())


def append_vertices(path: Path, block: Block) -> None:
    """Append points to a cloud that `write_clouds` wrote; colours, where it has them, are black.

    Raises:
        InputError: it is damaged.
    """
    layout, whole = ply.read_layout(path), path.with_suffix(".whole")
    fields = [(name, layout.dtype[name].str.lstrip("|")) for name in layout.dtype.names or ()]
    with path.open("rb") as before, whole.open("wb") as file:
        file.write(ply.make_header(fields, layout.rows + len(block.points)))
        before.seek(layout.start)
        shutil.copyfileobj(before, file)
        file.write(make_vertices(block, fields).tobytes())
    whole.replace(path)


def cloud_fields(cloud: Cloud, colours: Fields) -> Fields:
    """FIELDS of the points of a cloud, with `colours` where it has them; those of one that is far
    from the origin have coordinates of 64 bits."""
    return coordinate_fields(FIELDS, cloud.is_far) + (colours if cloud.has_colors else [])


def coordinate_fields(fields: Fields, is_far: bool) -> Fields:
    """Fields of which x, y and z have 64 bits where they are far from the origin."""
    if not is_far:
        return fields
    return [(name, "<f8" if name in ("x", "y", "z") else kind) for name, kind in fields]


def put_colours(vertices: NDArray[np.void], colours: NDArray[np.uint8]) -> None:
    """Sets `red`, `green` and `blue` of vertices (n,) to colours (n, 3)."""
    for (name, _), column in zip(COLOURS, colours.T, strict=True):
        vertices[name] = column


def make_vertices(block: Block, fields: Fields) -> NDArray[np.void]:
    """(n,) points with FIELDS and, for colours, COLOURS or PACKED_COLOUR."""
    vertices = np.zeros(len(block.points), fields)
    vertices["x"], vertices["y"], vertices["z"] = block.points.T
    vertices["p_static"] = block.p_static
    if block.colors is not None and fields[-1:] == PACKED_COLOUR:
        red, green, blue = block.colors.T.astype(np.uint32)
        vertices["rgb"] = red << 16 | green << 8 | blue
    elif block.colors is not None:
        put_colours(vertices, block.colors)
    return vertices
