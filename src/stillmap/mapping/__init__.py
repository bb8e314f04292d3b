"""Changed places, doors, and the projection of 3D recordings onto the plane."""

from stillmap.mapping.change_detection import Change as Change
from stillmap.mapping.change_detection import MoverPoints as MoverPoints
from stillmap.mapping.change_detection import detect_changes as detect_changes
from stillmap.mapping.changed_beams import find_changed_object_beams as find_changed_object_beams
from stillmap.mapping.changed_beams import relabel_changes as relabel_changes
from stillmap.mapping.changed_beams import update_occupancy as update_occupancy
from stillmap.mapping.changed_objects import detect_changes_3d as detect_changes_3d
from stillmap.mapping.door_detection import find_doors as find_doors
from stillmap.mapping.door_detection import join_doors as join_doors
from stillmap.mapping.doors import Door as Door
from stillmap.mapping.lone_doors import find_lone_doors as find_lone_doors
from stillmap.mapping.lone_doors import relabel_lone_doors as relabel_lone_doors
