"""Places that changed while the robot recorded: things put there, taken away, moved, and doors."""

from stillmap.mapping.change_detection import Change, beams_on_things, changed_places
from stillmap.mapping.change_detection_3d import changed_things
from stillmap.mapping.doors import swept_cells
from stillmap.mapping.relabelling import relabelled

__all__ = [
    "Change",
    "beams_on_things",
    "changed_places",
    "changed_things",
    "relabelled",
    "swept_cells",
]
