"""Ten corridors that look the same: whoever closes loops by looks alone takes one for another."""

from stillmap.simulation.options import CrowdOptions
from stillmap.simulation.scene import Point, Scene, Segment
from stillmap.simulation.walls import Opening, box, room, wall

_COUNT = 10
_APART = 6.0  # m from one corridor to the next
_WIDTH, _LENGTH = 2.2, 32.0  # m, of a corridor
_SPINE = 2.4  # m, width of the two corridors across their ends

# along each corridor, the same in all: closed doors, niches, and one open room with a desk
_WEST = (Opening(3.0, 0.95, 0.18), Opening(9.5, 0.95, 0.18), Opening(23.0, 1.6, 0.4))
_EAST = (Opening(6.0, 0.95, 0.18), Opening(27.5, 0.95, 0.18))
_DOOR, _ROOM, _DEPTH = Opening(15.0, 1.0, 0.15, is_open=True), (14.0, 19.5), 3.3
# along the spines, before each corridor and between two
_OPPOSITE, _BETWEEN = Opening(0.6, 1.0, 0.3), Opening(1.4, 0.95, 0.18)


def ten_corridors(people: int = 4) -> Scene:
    """Ten parallel corridors of 32 m, alike to the millimetre, between two corridors across.

    The same doors and niches at the same places, and across their ends too; only the two outer
    walls tell where one is. The robot goes up one corridor and down the next, then once more up
    the seventh and down the fourth, and back to where it began.
    """
    walls: list[Segment] = []
    for k in range(_COUNT):
        walls += _corridor(k * _APART)
    east, north = (_COUNT - 1) * _APART + _WIDTH, _LENGTH + _SPINE
    opposite = [_moved(_OPPOSITE, k * _APART) for k in range(_COUNT)]
    walls += wall((0.0, -_SPINE), east, "south", opposite)
    walls += wall((0.0, north), east, "north", opposite)
    for x in (0.0, east):
        walls += [(x, -_SPINE, x, 0.0), (x, _LENGTH, x, north)]
    return Scene(
        name="ten-corridors",
        walls=tuple(walls),
        route=tuple(_route()),
        crowd=CrowdOptions(people=people),
    )


def _corridor(x: float) -> list[Segment]:
    """A corridor with what lies between it and the next one, if there is one."""
    east = (x + _WIDTH, 0.0)
    walls = wall((x, 0.0), _LENGTH, "west", _WEST)
    walls += wall(east, _LENGTH, "east", [_EAST[0], _DOOR, _EAST[1]])
    walls += room(east, "east", _ROOM, _DEPTH, _DOOR)
    walls += box(x + _WIDTH + 2.9, 18.4, 0.8, 1.6)
    if x < (_COUNT - 1) * _APART:
        walls += wall(east, _APART - _WIDTH, "north", [_BETWEEN])
        walls += wall((x + _WIDTH, _LENGTH), _APART - _WIDTH, "south", [_BETWEEN])
    return walls


def _moved(opening: Opening, along: float) -> Opening:
    return Opening(opening.start + along, opening.width, opening.depth, opening.is_open)


def _route() -> list[Point]:
    """There and back through one corridor after the other, and two of them again."""
    south, north = -_SPINE / 2, _LENGTH + _SPINE / 2
    route: list[Point] = []
    for k in [*range(_COUNT), 6, 3]:
        x = k * _APART + _WIDTH / 2
        up = len(route) % 4 == 0
        route += [(x, south), (x, north)] if up else [(x, north), (x, south)]
    return [*route, route[0]]
