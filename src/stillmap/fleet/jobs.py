"""The job of a fleet, how its tasks end, and its result."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from stillmap.core.profiling import Show
from stillmap.fleet.inputs import Entry, Source

_FACTS = ("scans", "beams", "duration_s", "bytes")  # in `fleet.json`
RESULTS, PLACES = "results", "places"  # folders of the fleet


class Request(NamedTuple):
    """The job of a fleet.

    Attributes:
        entries: recordings, folders and patterns of them, with their places.
        output: folder or URL of the fleet.
        command: runs a command line of stillmap on a worker; a function of a module.
        map_flags, merge_flags: flags of `map` and `merge`.
        jobs: local processes at once.
        scheduler: address of a Dask scheduler; empty: local processes.
        fail: takes a line about a recording or a place that failed.
        progress: takes what is done, and how many of how many have ended.
    """

    entries: Sequence[Entry]
    output: str
    command: Callable[[list[str]], None]
    fail: Callable[[str], None]
    progress: Show
    map_flags: tuple[str, ...] = ()
    merge_flags: tuple[str, ...] = ()
    jobs: int = 1
    scheduler: str = ""


@dataclass(frozen=True)
class Outcome:
    """The outcome of a task.

    Attributes:
        status: `done`, `failed`, or `full`: a disk is, and no task can go on.
        why: one line; empty where it is done.
        key: of what the result was made from.
        input: its recording, or the first of them.
        cpu_seconds: of its worker meanwhile.
        peak_memory_bytes: of its worker.
        summary: of the result, JSON-able.
    """

    status: Literal["done", "failed", "full"]
    why: str = ""
    key: str = ""
    input: str = ""
    cpu_seconds: float = 0.0
    peak_memory_bytes: int = 0
    summary: dict[str, Any] = field(default_factory=dict)

    @property
    def is_done(self) -> bool:
        """Whether the result is there."""
        return self.status == "done"


class Job(NamedTuple):
    """A recording, and how mapping it ended."""

    source: Source
    outcome: Outcome


class Place(NamedTuple):
    """A place, its recordings, and how merging their results ended; None: too few to merge."""

    name: str
    jobs: list[Job]
    outcome: Outcome | None

    @property
    def is_done(self) -> bool:
        """Whether its result is there."""
        return self.outcome is not None and self.outcome.is_done

    @property
    def why(self) -> str:
        """Why there is no result."""
        if self.outcome is not None:
            return self.outcome.why
        n = sum(job.outcome.is_done for job in self.jobs)
        return f"merging takes two maps, this place has {n or 'none'}"


class Fleet(NamedTuple):
    """Result of a fleet."""

    jobs: list[Job]
    places: list[Place]

    @property
    def failed(self) -> int:
        """How many recordings and places failed."""
        merged = [place.outcome for place in self.places if place.outcome is not None]
        return sum(not one.is_done for one in [*(job.outcome for job in self.jobs), *merged])

    def to_list(self) -> list[dict[str, Any]]:
        """The content of `fleet.json`: an entry for each recording."""
        places = {place.name: place for place in self.places}
        return [_describe(job, places.get(job.source.place or "")) for job in self.jobs]


def _describe(job: Job, place: Place | None) -> dict[str, Any]:
    source, outcome = job.source, job.outcome
    merged = place is not None and place.is_done
    return {
        "input": source.input,
        "name": source.name,
        "place": source.place,
        "status": outcome.status,
        "why": outcome.why,
        "result": f"{RESULTS}/{source.name}" if outcome.is_done else None,
        "cpu_seconds": round(outcome.cpu_seconds, 3),
        "peak_memory_bytes": outcome.peak_memory_bytes,
        **{name: outcome.summary.get(name) for name in _FACTS},
        "place_result": f"{PLACES}/{source.place}" if merged else None,
        "place_why": "" if place is None or merged else place.why,
    }
