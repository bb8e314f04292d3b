"""The points of a result in 3D, in the map frame, some at a time."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.chunks import Chunk, iter_chunks
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.timestamps import beam_stamps_ns
from stillmap.io.point_cloud import ply
from stillmap.io.point_cloud.binary_table import read_columns
from stillmap.mapping.beam_statistics import DYNAMIC_BELOW

Part = Literal["static", "dynamic"]
PARTS: tuple[Part, ...] = ("static", "dynamic")

_FIELDS = ("x", "y", "z", "p_static")
_COLOURS = ("red", "green", "blue")


class Block(NamedTuple):
    """Some n points.

    Attributes:
        points: (n, 3) float64 metres in the map frame.
        p_static: (n,) float32.
        stamp_ns: (n,) int64, when each was taken; None where nobody knows.
        colours: (n, 3) uint8; None where the cloud has none.
    """

    points: NDArray[np.float64]
    p_static: NDArray[np.float32]
    stamp_ns: NDArray[np.int64] | None
    colors: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class Cloud:
    """All points.

    Attributes:
        count: how many.
        origin: (3,) whole metres that lie among them.
        start_ns: none was taken before; None where nobody knows when.
        blocks: makes them anew.
        coloured: whether points have colours.
    """

    count: int
    origin: NDArray[np.float64]
    start_ns: int | None
    make_blocks: Callable[[], Iterator[Block]]
    has_colors: bool = False

    def iter_blocks(self, tell: Callable[[float], None] | None) -> Iterator[Block]:
        """The blocks; `tell` hears which share of the points was taken."""
        done = 0
        for block in self.make_blocks():
            yield block
            done += len(block.points)
            if tell is not None:
                tell(done / max(self.count, 1))


def cloud_from_recording(
    recording: Recording,
    seen: Recording,
    poses: NDArray[np.float64],
    p_static: NDArray[np.float32],
    only: Part | None = None,
    colours: NDArray[np.uint8] | None = None,
) -> Cloud:
    """Every hit, in the recording's order; memory is that of some scans.

    Args:
        recording: 3D, T scans with M beams, T >= 1.
        seen: the same without the motion during its scans.
        poses: (T, 4, 4) T_map_base.
        p_static: (M,) P(c = 1).
        only: the points on one side of one half alone.
        colours: (M, 3); None: without.
    """
    times = recording.beam_time
    earliest = 0.0
    for block in () if times is None else arrays.iter_blocks(times):
        earliest = min(earliest, float(times[block].min()) if times is not None else 0.0)
    T_map_sensor = seen.T_map_sensor(poses)

    def made() -> Iterator[Block]:
        beside = [one for one in (p_static, times, colours) if one is not None]
        for chunk in iter_chunks(seen, release=beside):
            hits = _wanted(seen.hit[chunk.beams], p_static[chunk.beams], only)
            points = _placed(seen, chunk, hits, T_map_sensor)
            stamp_ns = beam_stamps_ns(recording, chunk.scans)[hits]
            its = None if colours is None else np.asarray(colours[chunk.beams][hits])
            yield Block(points, np.asarray(p_static[chunk.beams][hits]), stamp_ns, its)

    return Cloud(
        count=sum(
            int(np.count_nonzero(_wanted(seen.hit[block], p_static[block], only)))
            for block in arrays.iter_blocks(seen.hit, p_static)
        ),
        origin=np.round(poses[0, :3, 3]),
        start_ns=int(recording.stamp_ns[0]) + int(np.floor(1e9 * earliest)),
        make_blocks=made,
        has_colors=colours is not None,
    )


def cloud_from_folder(folder: Path, only: Part | None = None) -> Cloud:
    """The points of `static.ply` and `dynamic.ply`: nobody knows any more when each was taken.

    Raises:
        InputError: one of them is missing or damaged.
    """
    layouts = [ply.read_layout(folder / f"{part}.ply") for part in PARTS if only in (part, None)]
    coloured = all(set(_COLOURS) <= {one.name for one in layout.fields} for layout in layouts)
    wanted = (*_FIELDS, *(_COLOURS if coloured else ()))

    def made() -> Iterator[Block]:
        for layout in layouts:
            for values in read_columns(layout, wanted):
                points = np.stack(values[:3], axis=1).astype(np.float64)
                if not np.isfinite(points).all():
                    raise InputError("holds a point that is not finite", where=str(layout.path))
                colours = np.stack(values[4:], axis=1).astype(np.uint8) if coloured else None
                yield Block(points, values[3].astype(np.float32), None, colours)

    return Cloud(sum(layout.rows for layout in layouts), np.zeros(3), None, made, coloured)


def _wanted(
    hit: NDArray[np.bool_], p_static: NDArray[np.float32], only: Part | None
) -> NDArray[np.bool_]:
    if only is None:
        return np.asarray(hit)
    dynamic = p_static < DYNAMIC_BELOW
    return np.asarray(hit & (dynamic if only == "dynamic" else ~dynamic))


def _placed(
    seen: Recording, chunk: Chunk, chosen: NDArray[np.bool_], T_map_sensor: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(n, 3) metres in the map frame: the chosen of a chunk's beams."""
    out = np.empty((int(np.count_nonzero(chosen)), 3))
    taken, points = 0, seen.points[chunk.beams]
    for n, t in enumerate(range(chunk.scans.start, chunk.scans.stop)):
        beams, T = slice(int(chunk.offset[n]), int(chunk.offset[n + 1])), T_map_sensor[t]
        its = points[beams][chosen[beams]].astype(np.float64)
        out[taken : taken + len(its)] = its @ T[:3, :3].T + T[:3, 3]
        taken += len(its)
    return out
