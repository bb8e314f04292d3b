"""Many recordings mapped, and merged per place, by Dask: `stillmap fleet`."""

from stillmap.fleet.jobs import Fleet, Request
from stillmap.fleet.run import run_fleet

__all__ = ["Fleet", "Request", "run_fleet"]
