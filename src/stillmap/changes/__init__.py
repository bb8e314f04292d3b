"""Places that changed while the robot recorded: things put there, taken away, moved, and doors."""

from stillmap.changes.in_space import changed_things
from stillmap.changes.places import Change, beams_on_things, changed_places
from stillmap.changes.relabelled import relabelled
from stillmap.changes.swept import swept_cells

__all__ = [
    "Change",
    "beams_on_things",
    "changed_places",
    "changed_things",
    "relabelled",
    "swept_cells",
]
