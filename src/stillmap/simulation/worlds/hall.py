"""An exhibition hall."""

from stillmap.simulation.lidar_options import HeightOptions
from stillmap.simulation.options import CrowdOptions
from stillmap.simulation.scene import Point, Scene
from stillmap.simulation.walls import Opening, box, pillar, room, wall


def hall(people: int = 15) -> Scene:
    """An exhibition hall of 45 x 30 m with columns, show cases and panels.

    Size and number of people are those of Haehnel, Triebel, Burgard, Thrun, Map building with
    mobile robots in dynamic environments, ICRA 2003, Sect. 4.1; what stands in it is made up.
    """
    niche = [Opening(5.0, 1.6, 0.35), Opening(13.5, 1.2, 0.25), Opening(21.0, 3.2, 0.6)]
    bay = Opening(28.0, 7.0, 0.3, is_open=True)
    walls = [
        *wall((0, 0), 45, "south", [*niche, Opening(33.5, 1.2, 0.25), Opening(40.0, 1.6, 0.35)]),
        *wall((0, 30), 45, "north", [Opening(7.0, 1.2), Opening(17.0, 2.4, 0.4), bay]),
        *room((0, 30), "north", (27.0, 36.5), 3.5, bay),
        *wall((0, 0), 30, "west", [Opening(6.0, 2.0, 0.4), Opening(19.0, 1.2, 0.3)]),
        *wall((45, 0), 13, "east", [Opening(3.0, 1.2, 0.3)]),
        *wall((45, 18), 12, "east", [Opening(6.5, 1.2, 0.3)]),
    ]
    for x in (7.5, 15.0, 22.5, 30.0, 37.5):
        walls += pillar(x, 9.5, 0.4, 12) + pillar(x, 20.5, 0.4, 12)
    for case in (
        (4.5, 14.6, 1.2, 2.4, 0.0),
        (10.9, 5.2, 2.0, 0.8, 0.1),
        (11.2, 24.8, 1.0, 1.0, 0.4),
        (19.2, 15.0, 2.4, 1.2, 0.0),
        (26.4, 5.8, 1.6, 0.8, -0.2),
        (34.2, 14.6, 1.2, 1.2, 0.6),
        (39.8, 24.2, 2.0, 1.0, 0.15),
        (40.6, 6.2, 1.0, 1.0, 0.0),
        (18.6, 2.4, 2.2, 0.7, 0.0),
    ):
        walls += box(*case)
    for panel in ((18.4, 24.8, 4.0), (27.0, 14.9, 5.0), (11.0, 15.1, 3.0)):
        walls += box(*panel, 0.15)
    walls += box(33.4, 6.6, 0.15, 4.0) + box(35.4, 4.675, 4.0, 0.15)
    west: list[Point] = [(23, 4), (14.5, 2.5), (5, 3.8), (2.4, 10), (2.4, 19), (5, 26.4)]
    north: list[Point] = [(13, 27.5), (15.3, 23.4), (22.5, 27), (31, 27.5), (31.5, 31.8), (31, 27)]
    east: list[Point] = [(38, 27), (43, 25), (42.4, 16), (43, 8), (38.5, 2.8), (30, 3.4)]
    middle: list[Point] = [(28, 9.5), (22.5, 12.4), (12, 12.2), (8, 17.6), (16, 18)]
    home: list[Point] = [(24, 18.6), (35, 18), (37, 11.5), (29.6, 11.2), (23, 4)]
    return Scene(
        name="hall",
        walls=tuple(walls),
        glass=((45.0, 13.0, 45.0, 18.0),),
        route=(*west, *north, *east, *middle, *home),
        crowd=CrowdOptions(people=people),
        heights=HeightOptions(ceiling=6.0, furniture=1.2),
    )
