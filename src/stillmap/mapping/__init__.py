"""Changed places, doors, and the projection of 3D recordings onto the plane."""

from stillmap.mapping.change_detection import Change, MoverPoints, detect_changes
from stillmap.mapping.changed_beams import (
    find_changed_object_beams,
    relabel_changes,
    update_occupancy,
)
from stillmap.mapping.changed_objects import detect_changes_3d
from stillmap.mapping.door_detection import find_doors, join_doors
from stillmap.mapping.doors import Door
from stillmap.mapping.lone_doors import find_lone_doors, relabel_lone_doors

__all__ = [
    "Change",
    "Door",
    "MoverPoints",
    "detect_changes",
    "detect_changes_3d",
    "find_changed_object_beams",
    "find_doors",
    "find_lone_doors",
    "join_doors",
    "relabel_changes",
    "relabel_lone_doors",
    "update_occupancy",
]
