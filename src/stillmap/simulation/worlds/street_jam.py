"""The street when everybody is on the road: cars stop and go, wait at lights, and stand in line."""

import dataclasses

from stillmap.simulation.options import TrafficOptions
from stillmap.simulation.scene import Lane, Light, Scene
from stillmap.simulation.worlds.street import INNER, OUTER, street

_EAST, _WEST = -110.0, 290.0  # m, x where the lanes to the east and to the west begin
_CYCLE = 50.0  # s


def street_jam(people: int = 16) -> Scene:
    """The street with two lights, at which the robot waits beside the cars, and a queue.

    Everybody stops now and then. The lane to the west is a queue, past most of which the robot has
    driven when it begins to move.
    """
    return dataclasses.replace(
        street(people),
        name="street-jam",
        lanes=(
            Lane(((_EAST, -INNER), (_WEST, -INNER)), lights=_lights(-INNER)),
            Lane(((_WEST, INNER), (_EAST, INNER)), waiting=11, stop=_WEST - 45.0, go=(95, -OUTER)),
        ),
        lights=(*_lights(-OUTER), Light((112.0, OUTER), (15.0, 33.0), _CYCLE)),
        traffic=TrafficOptions(
            vehicles=18, min_speed=4.0, max_speed=9.0, stopping_share=1.0, max_stop=15.0
        ),
    )


def _lights(y: float) -> tuple[Light, ...]:
    """Those that a lane to the east has, one after the other."""
    return (Light((48.0, y), (5.0, 25.0), _CYCLE), Light((118.0, y), (30.0, 48.0), _CYCLE))
