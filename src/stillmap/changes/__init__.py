"""Places that changed while the robot recorded: things put there, taken away, moved, and doors."""

from stillmap.changes.places import Change, beams_on_things, changed_places
from stillmap.changes.relabelled import relabelled
from stillmap.changes.swept import swept_cells

__all__ = ["Change", "beams_on_things", "changed_places", "relabelled", "swept_cells"]
