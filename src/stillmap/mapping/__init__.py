"""Changed places, doors, and the projection of 3D recordings onto the plane."""

from stillmap.mapping.cell_labels import update_occupancy
from stillmap.mapping.change_detection import Change, detect_changes
from stillmap.mapping.change_detection_3d import detect_changes_3d
from stillmap.mapping.changed_beams import find_changed_object_beams, relabel_changes
from stillmap.mapping.doors import compute_swept_cells
from stillmap.mapping.witnesses import MoverPoints

__all__ = [
    "Change",
    "MoverPoints",
    "compute_swept_cells",
    "detect_changes",
    "detect_changes_3d",
    "find_changed_object_beams",
    "relabel_changes",
    "update_occupancy",
]
