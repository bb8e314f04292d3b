"""`static.ply` and `dynamic.ply`: the end points of a 3D recording in the map frame."""

import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import iter_blocks
from stillmap.core.recording import Recording
from stillmap.em.types import DYNAMIC_BELOW
from stillmap.io.point_cloud.ply import read_layout
from stillmap.results.point_cloud import Block, Cloud, cloud_from_recording

Fields = list[tuple[str, str]]  # names and types

FIELDS: Fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("p_static", "<f4")]
COLOURS: Fields = [("red", "u1"), ("green", "u1"), ("blue", "u1")]
PACKED_COLOUR: Fields = [("rgb", "<u4")]  # 0x00RRGGBB, of PCD
_TYPES = {"<f4": "float", "<f8": "double", "u1": "uchar"}
_BLOCK = 1 << 16  # vertices in memory


def write_clouds(
    folder: Path,
    seen: Recording,
    poses: NDArray[np.float64],
    p_static: NDArray[np.float32],
    colours: NDArray[np.uint8] | None = None,
    origin: NDArray[np.float64] | None = None,
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
    dynamic = sum(
        int(np.count_nonzero(seen.hit[block] & (p_static[block] < DYNAMIC_BELOW)))
        for block in iter_blocks(seen.hit, p_static)
    )
    cloud = cloud_from_recording(seen, seen, poses, p_static, colors=colours, origin=origin)
    fields = cloud_fields(cloud, COLOURS)
    with (
        (folder / "static.ply").open("wb") as static,
        (folder / "dynamic.ply").open("wb") as moving,
    ):
        static.write(ply_header(fields, cloud.count - dynamic))
        moving.write(ply_header(fields, dynamic))
        for block in cloud.iter_blocks():
            for part in block.split(_BLOCK):
                vertices = make_vertices(part, fields)
                moves = vertices["p_static"] < DYNAMIC_BELOW
                static.write(vertices[~moves].tobytes())
                moving.write(vertices[moves].tobytes())


def append_vertices(path: Path, block: Block) -> None:
    """Append points to a cloud that `write_clouds` wrote; colours, where it has them, are black.

    Raises:
        InputError: it is damaged.
    """
    layout, whole = read_layout(path), path.with_suffix(".whole")
    fields = [(one.name, one.dtype.str.lstrip("|")) for one in layout.fields]
    with path.open("rb") as before, whole.open("wb") as file:
        file.write(ply_header(fields, layout.rows + len(block.points)))
        before.seek(layout.start)
        shutil.copyfileobj(before, file)
        for part in block.split(_BLOCK):
            file.write(make_vertices(part, fields).tobytes())
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


def ply_header(fields: Fields, count: int) -> bytes:
    """Of a little-endian PLY whose vertices have these fields, float32, float64 or uint8."""
    properties = "".join(f"property {_TYPES[kind]} {name}\n" for name, kind in fields)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}"
    return (head + "end_header\n").encode("ascii")


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
