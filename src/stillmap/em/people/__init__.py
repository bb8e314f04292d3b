"""People found as features and tracked, and the beams on them: the method before the paper's.

After D. Haehnel, D. Schulz, W. Burgard, *Map Building with Mobile Robots in Populated
Environments*, IROS 2002; docs/tracker.md says what is theirs and what is simpler here.
"""

from stillmap.em.options import TrackerOptions
from stillmap.em.people.tracker import label_people

__all__ = ["TrackerOptions", "label_people"]
