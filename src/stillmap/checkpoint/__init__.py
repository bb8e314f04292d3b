"""How far a run has come, kept beside its result so that another can go on after an interruption.

docs/long.md says what users see of it.
"""

from stillmap.checkpoint.identity import identity
from stillmap.checkpoint.place import Damaged, Place, held

__all__ = ["Damaged", "Place", "held", "identity"]
