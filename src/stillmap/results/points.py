"""`static.ply` and `dynamic.ply`: the end points of a 3D recording in the map frame."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import iter_blocks
from stillmap.core.chunks import iter_chunks
from stillmap.core.recording import Recording
from stillmap.em.types import DYNAMIC_BELOW

FIELDS = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("p_static", "<f4")]

COLOURS = [("red", "u1"), ("green", "u1"), ("blue", "u1")]

_TYPES = {"<f4": "float", "u1": "uchar"}


def write_clouds(
    folder: Path,
    seen: Recording,
    poses: NDArray[np.float64],
    p_static: NDArray[np.float32],
    colours: NDArray[np.uint8] | None = None,
) -> None:
    """Write every hit to one of the two files; memory is that of a few scans.

    Args:
        folder: where to.
        seen: 3D, M beams without the motion during its scans.
        poses: (T, 4, 4) T_map_base.
        p_static: (M,) P(c = 1); below one half it is dynamic.
        colours: (M, 3), None: without.
    """
    hits = dynamic = 0
    for block in iter_blocks(seen.hit, p_static):
        hit = seen.hit[block]
        hits += int(np.count_nonzero(hit))
        dynamic += int(np.count_nonzero(hit & (p_static[block] < DYNAMIC_BELOW)))
    counts = {"static": hits - dynamic, "dynamic": dynamic}
    files = {name: (folder / f"{name}.ply").open("wb") for name in counts}
    try:
        for name, file in files.items():
            fields = FIELDS if colours is None else FIELDS + COLOURS
            file.write(ply_header(fields, counts[name]))
        for vertices in _vertices(seen, poses, p_static, colours):
            moves = vertices["p_static"] < DYNAMIC_BELOW
            files["static"].write(vertices[~moves].tobytes())
            files["dynamic"].write(vertices[moves].tobytes())
    finally:
        for file in files.values():
            file.close()


def ply_header(fields: list[tuple[str, str]], count: int) -> bytes:
    """Of a little-endian PLY whose vertices have these fields, float32 or uint8."""
    properties = "".join(f"property {_TYPES[kind]} {name}\n" for name, kind in fields)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}"
    return (head + "end_header\n").encode("ascii")


def put_colours(vertices: NDArray[np.void], colours: NDArray[np.uint8]) -> None:
    """Sets `red`, `green` and `blue` of vertices (n,) to colours (n, 3)."""
    for (name, _), column in zip(COLOURS, colours.T, strict=True):
        vertices[name] = column


def _vertices(
    seen: Recording,
    poses: NDArray[np.float64],
    p_static: NDArray[np.float32],
    colours: NDArray[np.uint8] | None,
) -> Iterator[NDArray[np.void]]:
    T_map_sensor = seen.T_map_sensor(poses)
    fields = FIELDS if colours is None else FIELDS + COLOURS
    beside: list[NDArray[Any]] = [p_static] if colours is None else [p_static, colours]
    for scans, beams, offset in iter_chunks(seen, release=beside):
        for t, first, last in zip(
            range(scans.start, scans.stop), offset[:-1], offset[1:], strict=True
        ):
            at = slice(beams.start + int(first), beams.start + int(last))
            hit = seen.hit[at]
            T = T_map_sensor[t]
            ends = seen.points[at][hit].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
            vertices = np.empty(len(ends), fields)
            vertices["x"], vertices["y"], vertices["z"] = ends.T
            vertices["p_static"] = p_static[at][hit]
            if colours is not None:
                put_colours(vertices, colours[at][hit])
            yield vertices
