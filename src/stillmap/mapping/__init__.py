"""Places that changed while the robot recorded: things put there, taken away, moved, and doors."""

from stillmap.mapping.change_detection import Change, detect_changes, find_changed_object_beams
from stillmap.mapping.change_detection_3d import detect_changes_3d
from stillmap.mapping.doors import compute_swept_cells
from stillmap.mapping.relabelling import relabel_changes

__all__ = [
    "Change",
    "find_changed_object_beams",
    "detect_changes",
    "detect_changes_3d",
    "relabel_changes",
    "compute_swept_cells",
]
