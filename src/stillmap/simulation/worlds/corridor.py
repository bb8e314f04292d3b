"""A loop of corridors."""

from stillmap.simulation.options import CrowdOptions
from stillmap.simulation.scene import Point, Scene, Segment
from stillmap.simulation.walls import Opening, Side, box, pillar, polyline, room, wall


def corridor(people: int = 20) -> Scene:
    """A loop of corridors 2.4 m wide around a block, with offices, closed doors and a lobby."""
    walls: list[Segment] = []
    for start, length, side, niches, rooms in _CORRIDOR_SIDES:
        doors = [Opening(x, is_open=True) for x, *_ in rooms]
        openings = [Opening(x, 0.95, 0.18) for x in niches] + doors
        if side == "north" and start == (0, 22):
            openings.append(_LOBBY)
        walls += wall(start, length, side, sorted(openings, key=lambda o: o.start))
        for door, (_, low, high, depth) in zip(doors, rooms, strict=True):
            walls += room(start, side, (low, high), depth, door)
    for furniture in _FURNITURE:
        walls += box(*furniture)
    walls += pillar(21.5, 22.9, 0.2)
    walls += polyline([(18.5, 25.0), (20.0, 25.0)]) + polyline([(23.0, 25.0), (24.5, 25.0)])
    lap_east: list[Point] = [(34.8, 1.2), (34.8, 20.8), (22.5, 21.2)]
    lap_west: list[Point] = [(1.2, 20.8), (1.2, 10.5), (1.2, 1.2)]
    first: list[Point] = [(18, 1.2), (24, 1.2), (24, -1.4), (24, 1.2), *lap_east]
    first += [(9.5, 20.8), (9.5, 23.6), (9.5, 20.8), *lap_west, (7.5, 1.2), (7.5, -1.8)]
    second: list[Point] = [(7.5, 1.2), *lap_east, *lap_west, (14.9, 1.2), (14.9, 4.0)]
    return Scene(
        name="corridor",
        walls=tuple(walls),
        glass=((20.0, 25.0, 23.0, 25.0),),
        route=(*first, *second, (14.9, 1.2), (18, 1.2)),
        crowd=CrowdOptions(people=people),
    )


_LOBBY = Opening(18.5, 6.0, 3.0, is_open=True)

# where a wall begins, its length, the side that its doors step back to, where closed doors begin,
# and open offices: where the door begins, where the office begins and ends, its depth
_CORRIDOR_SIDES: tuple[
    tuple[Point, float, Side, tuple[float, ...], tuple[tuple[float, float, float, float], ...]], ...
] = (
    ((0, 0), 36, "south", (2.8, 12, 17.2, 29.5, 33), ((7, 4, 10.5, 4.5), (23.5, 20.5, 27.5, 4))),
    ((0, 22), 36, "north", (3.6, 15, 27), ((9, 6, 13, 4), (31, 28.5, 35, 4.2))),
    ((0, 0), 22, "west", (5, 16.5), ((10, 8.5, 13.5, 4),)),
    ((36, 0), 22, "east", (4.2, 9, 18), ()),
    ((2.4, 2.4), 31.2, "north", (1.5, 6.2, 19, 24.4, 28.4), ((12, 9.5, 16, 5),)),
    ((2.4, 19.6), 31.2, "south", (3.2, 8.8, 18), ((25, 21, 28.5, 4.6),)),
    ((2.4, 2.4), 17.2, "east", (4, 10.6), ()),
    ((33.6, 2.4), 17.2, "west", (3, 14.5), ((8.5, 5, 11, 4.2),)),
)

# centre x, y, width, height, in corridors and offices
_FURNITURE = (
    (20.2, 2.2, 1.6, 0.4),
    (35.75, 13.5, 0.5, 1.8),
    (14.0, 21.8, 0.8, 0.4),
    (5.2, -3.9, 1.6, 0.8),
    (9.7, -2.6, 0.8, 1.6),
    (24.2, -2.8, 2.4, 1.0),
    (7.0, 25.5, 1.6, 0.8),
    (12.2, 24.2, 0.8, 1.6),
    (33.6, 25.4, 1.6, 0.8),
    (-3.2, 12.7, 1.6, 0.8),
    (12.9, 6.4, 0.8, 1.6),
    (17.4, 6.9, 1.6, 0.8),
    (25.0, 16.0, 2.0, 1.0),
    (29.8, 9.4, 0.8, 1.6),
)
