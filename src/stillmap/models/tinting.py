"""Colours of the beams' end points: of what stands still as the surface there is painted, of what
moves from pictures taken about when it was seen."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.em.chunks import Chunk, chunks
from stillmap.models.ahead import Ahead
from stillmap.models.moving_points import Moving, tint_moving
from stillmap.models.options import MeshOptions
from stillmap.models.own import Moves
from stillmap.models.sources import Sources
from stillmap.output.points import DYNAMIC_BELOW
from stillmap.recording import spool
from stillmap.texture.points import PaintedMesh
from stillmap.texture.textured import GREY, Textured
from stillmap.threads import in_order

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Colours = NDArray[np.uint8]
Tell = Callable[[int, int], None]

_TOGETHER = 1 << 16  # points


@dataclass(frozen=True, eq=False)
class Tints:
    """Colours of the ends of M beams.

    Attributes:
        colours: (M, 3) uint8, as photographed (sRGB); GREY where no picture tells, and only there.
        counts: numbers of hits, `static` and `dynamic`, and how many of them have a colour:
            `static_coloured`, `dynamic_coloured`.
    """

    colours: Colours
    counts: dict[str, int]


def tinted(
    sources: Sources,
    textured: Textured,
    place: Ahead,
    moves: Moves,
    options: MeshOptions,
    threads: int = 1,
    tell: Tell | None = None,
) -> Tints:
    """The colour of each beam's end.

    What lies on the surface of the place has the colour that is painted there: of a picture that
    probably shows nothing that moves before it. What moves is carried along its track to the time
    of pictures `mesh.objects.near` seconds from then at most; of those that show it the nearest in
    time counts. What is of no track has none.

    Args:
        sources: M beams.
        textured: the surface of the place.
        place: what stands still, and the pictures that can be used.
        moves: the beams on what moves.
        options: see MeshOptions.
        threads: same result with any number.
        tell: called with what is done, and how much of it.
    """
    recording = sources.recording
    out: Colours = recording.per_beam(np.uint8, (3,))
    scans, n = recording.n_scans, recording.n_scans + len(place.views)
    painted = PaintedMesh(textured, options.points.off)
    T_map_sensor = sources.seen.T_map_sensor(sources.poses)
    for chunk in chunks(sources.seen, beside=[sources.p_static, out]):
        out[chunk.beams] = GREY
        _tint_static(out, chunk, sources, T_map_sensor, painted, threads)
        if tell is not None:
            tell(chunk.scans.stop, n)
    late = recording.per_beam(np.float32)
    for block in spool.blocks(late):
        late[block] = np.inf
    moving = Moving(sources, moves)
    for number in range(len(place.views)):
        tint_moving(out, late, moving, number, place, options)
        sources.seen.let_go(sources.p_static, out, late)
        if tell is not None:
            tell(scans + number + 1, n)
    return Tints(out, _counts(out, sources))


def _counts(colours: Colours, sources: Sources) -> dict[str, int]:
    hit, p_static = sources.seen.hit, sources.p_static
    out = dict.fromkeys(("static", "static_coloured", "dynamic", "dynamic_coloured"), 0)
    for block in spool.blocks(hit, p_static, colours):
        has, still = (colours[block] != GREY).any(axis=1), p_static[block] >= DYNAMIC_BELOW
        for name, part in (("static", hit[block] & still), ("dynamic", hit[block] & ~still)):
            out[name] += int(np.count_nonzero(part))
            out[f"{name}_coloured"] += int(np.count_nonzero(part & has))
    return out


def _tint_static(
    out: Colours,
    chunk: Chunk,
    sources: Sources,
    T_map_sensor: Float,
    painted: PaintedMesh,
    threads: int,
) -> None:
    """Colours what stands still of some scans."""
    beams = chunk.beams
    still = sources.seen.hit[beams] & (sources.p_static[beams] >= DYNAMIC_BELOW)
    numbers = np.flatnonzero(still)
    scan = np.searchsorted(chunk.offset, numbers, side="right") - 1 + chunk.scans.start
    parts = [slice(k, k + _TOGETHER) for k in range(0, len(numbers), _TOGETHER)]

    def found(part: slice) -> tuple[slice, Colours, Bool]:
        T = T_map_sensor[scan[part]]
        local = sources.seen.points[beams.start + numbers[part]].astype(np.float64)
        ends = np.einsum("nij,nj->ni", T[:, :3, :3], local) + T[:, :3, 3]
        return part, *painted.colours(ends, T[:, :3, 3])

    for part, colours, has in in_order(found, parts, threads):
        out[beams.start + numbers[part][has]] = colours[has]
