"""Draw rooms.svg, the room plan of architecture.md: a room uses only rooms below it.

python docs/figures/draw_rooms.py
"""

from pathlib import Path
from typing import NamedTuple

COLUMN, ROW, HEIGHT, MARGIN = 72, 66, 42, 16  # pixels
INK, FILL, FRAME = "#1f2933", "#e8f0f8", "#33658a"


class Room(NamedTuple):
    """A folder of src/stillmap: floor from the top, first and last column, what it holds."""

    name: str
    floor: int
    left: float
    right: float
    text: str


ROOMS = (
    Room("cli", 0, 0, 12, "commands: parse, read, build, save"),
    Room("eval", 1, 0, 2.4, "scores against truth"),
    Room("viewer", 1, 4.5, 6.15, "in the browser"),
    Room("fleet", 1, 6.35, 8, "many recordings"),
    Room("live", 1, 2.6, 4.3, "scan by scan"),
    Room("places", 2, 3.2, 6.15, "many sessions"),
    Room("results", 3, 0, 8, "writers and readers of the result folder, exports, report"),
    Room("pipeline", 4, 0, 8, "the EM loop, its options, result and checkpoint"),
    Room("mesh", 5, 0, 4, "surface, textures, object models"),
    Room("rig", 6, 0, 4, "planar laser + tilting laser"),
    Room("tracking", 7, 0, 4, "objects: clusters, tracks, boxes"),
    Room("sim", 7, 9.2, 12, "worlds with truth"),
    Room("mapping", 8, 0, 4, "projection, changed places"),
    Room("slam", 8, 4.5, 8, "M-step: poses, loops"),
    Room("io", 8, 8.5, 12, "formats to Recording"),
    Room("em", 9, 0, 8, "E-steps: P(static) of every beam, occupancy map, bound"),
    Room("prepare", 9, 8.5, 12, "self filter, range limits"),
    Room("core", 10, 0, 12, "Recording, camera, SE(2)/SE(3), config, errors, files, parallel"),
)
ARROWS = (  # from, to, column
    ("cli", "eval", 1.2),
    ("cli", "viewer", 5.3),
    ("cli", "fleet", 7.2),
    ("cli", "live", 3.8),
    ("cli", "io", 8.85),
    ("cli", "sim", 10.6),
    ("live", "places", 3.8),
    ("eval", "results", 1.2),
    ("viewer", "places", 5.3),
    ("places", "results", 5.3),
    ("fleet", "results", 7.2),
    ("results", "pipeline", 4),
    ("pipeline", "mesh", 2),
    ("pipeline", "slam", 6.25),
    ("mesh", "rig", 2),
    ("rig", "tracking", 2),
    ("tracking", "mapping", 2),
    ("sim", "io", 10.6),
    ("mapping", "em", 2),
    ("slam", "em", 6.25),
    ("io", "prepare", 10.25),
    ("em", "core", 4),
    ("prepare", "core", 10.25),
)


def draw_room(room: Room) -> str:
    x, y = MARGIN + room.left * COLUMN, MARGIN + room.floor * ROW
    width = (room.right - room.left) * COLUMN
    return (
        f'<rect x="{x:g}" y="{y}" width="{width:g}" height="{HEIGHT}" rx="4" fill="{FILL}" '
        f'stroke="{FRAME}"/>'
        f'<text x="{x + 10:g}" y="{y + 17}" font-weight="bold">{room.name}</text>'
        f'<text x="{x + 10:g}" y="{y + 33}" font-size="12">{room.text}</text>'
    )


def draw_arrow(above: Room, below: Room, column: float) -> str:
    if below.floor <= above.floor:
        raise ValueError(f"{above.name} -> {below.name}: arrows go down")
    x = MARGIN + column * COLUMN
    y0, y1 = MARGIN + above.floor * ROW + HEIGHT, MARGIN + below.floor * ROW - 2
    return f'<path d="M{x:g} {y0}V{y1}" stroke="{INK}" stroke-width="1.4" marker-end="url(#head)"/>'


def main() -> None:
    """Write the SVG."""
    rooms = {room.name: room for room in ROOMS}
    width = 2 * MARGIN + 12 * COLUMN
    height = 2 * MARGIN + max(room.floor for room in ROOMS) * ROW + HEIGHT
    arrows = (draw_arrow(rooms[above], rooms[below], column) for above, below, column in ARROWS)
    lines = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}" font-family="sans-serif" font-size="14" fill="{INK}">',
        '<defs><marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
        f'markerHeight="7" orient="auto"><path d="M0 0L8 4L0 8z" fill="{INK}"/></marker></defs>',
        '<rect width="100%" height="100%" fill="#fff"/>',
        *map(draw_room, ROOMS),
        *arrows,
        "</svg>",
    )
    (Path(__file__).parent / "rooms.svg").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
