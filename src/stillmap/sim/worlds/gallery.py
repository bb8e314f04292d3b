"""A gallery whose mirrors show rooms where there are none."""

from stillmap.sim.options import CrowdOptions
from stillmap.sim.scene import Point, Scene, Segment
from stillmap.sim.walls import box, pillar, polyline

_WIDTH, _DEPTH = 28.0, 18.0  # m

# along the outer walls: from where to where
_SOUTH_MIRRORS = ((4.0, 8.5), (17.0, 23.0))
_NORTH_MIRRORS = ((10.0, 16.0),)
_WEST_MIRRORS = ((6.0, 10.5),)
_EAST_GLASS = ((10.0, 14.0),)


def gallery() -> Scene:
    """A gallery of 28 x 18 m with mirrors in three walls and on a screen, and a glass front."""
    walls: list[Segment] = []
    mirrors: list[Segment] = []
    glass: list[Segment] = []
    for parts, y in ((_SOUTH_MIRRORS, 0.0), (_NORTH_MIRRORS, _DEPTH)):
        walls += [(a, y, b, y) for a, b in _gaps(parts, _WIDTH)]
        mirrors += [(a, y, b, y) for a, b in parts]
    for parts, x, kind in ((_WEST_MIRRORS, 0.0, mirrors), (_EAST_GLASS, _WIDTH, glass)):
        walls += [(x, a, x, b) for a, b in _gaps(parts, _DEPTH)]
        kind += [(x, a, x, b) for a, b in parts]
    # screens; the second has a mirror on its east side
    walls += box(8.0, 12.6, 0.2, 5.0) + box(20.0, 6.0, 5.0, 0.2)
    walls += polyline([(14.0, 11.0), (13.8, 11.0), (13.8, 7.0), (14.0, 7.0)])
    mirrors.append((14.0, 7.0, 14.0, 11.0))
    for x, y in ((5.0, 5.0), (23.0, 13.0), (10.5, 4.0), (25.0, 4.5)):
        walls += pillar(x, y, 0.3, 10)
    for case in (
        (3.0, 14.5, 1.2, 0.8, 0.2),
        (17.5, 14.0, 1.6, 1.6, 0.5),
        (16.5, 2.8, 0.9, 0.9, 0.0),
        (22.6, 9.4, 2.0, 0.7, -0.3),
        (6.4, 8.8, 0.7, 0.7, 0.8),
    ):
        walls += box(*case)
    west: list[Point] = [(12.0, 2.0), (7.5, 2.2), (2.2, 2.4), (2.0, 7.5), (3.6, 11.5), (2.0, 16.4)]
    north: list[Point] = [(8.0, 16.6), (11.0, 15.0), (11.2, 9.0), (11.0, 13.0), (15.0, 16.2)]
    east: list[Point] = [(21.0, 15.5), (26.0, 16.0), (26.0, 10.5), (17.6, 11.0), (16.0, 8.5)]
    home: list[Point] = [(18.5, 8.0), (25.6, 7.6), (26.4, 2.0), (20.0, 2.2), (14.0, 4.5)]
    return Scene(
        name="gallery",
        walls=tuple(walls),
        glass=tuple(glass),
        mirrors=tuple(mirrors),
        route=(*west, *north, *east, *home),
        crowd=CrowdOptions(people=8),
    )


def _gaps(parts: tuple[tuple[float, float], ...], length: float) -> list[tuple[float, float]]:
    """Intervals, m, of a wall of that length which no part covers, ascending."""
    ends = [0.0, *(end for part in parts for end in part), length]
    return list(zip(ends[::2], ends[1::2], strict=True))
