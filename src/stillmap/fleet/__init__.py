"""Many recordings mapped, and merged per place, by Dask: `stillmap fleet`."""

from stillmap.fleet.run import Fleet, Request, run_fleet

__all__ = ["Fleet", "Request", "run_fleet"]
