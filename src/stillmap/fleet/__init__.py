"""Many recordings mapped, and merged per place: `stillmap fleet`."""

from stillmap.fleet.jobs import Fleet, Reporter, Request
from stillmap.fleet.run import run_fleet
from stillmap.fleet.settings import Settings

__all__ = ["Fleet", "Reporter", "Request", "Settings", "run_fleet"]
