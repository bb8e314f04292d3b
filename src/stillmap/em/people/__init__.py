"""People tracked in 2D scans, and the beams on them: a baseline.

After D. Haehnel, D. Schulz, W. Burgard, *Map Building with Mobile Robots in Populated
Environments*, IROS 2002; docs/tracker.md lists what is simpler here.
"""

from stillmap.em.people.tracker import label_people

__all__ = ["label_people"]
