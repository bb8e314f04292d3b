"""The job of a fleet, the state of its recordings and places, and its result."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from stillmap.fleet.artifacts import PLACES, RESULTS
from stillmap.fleet.inputs import Source
from stillmap.fleet.manifest import Entry
from stillmap.fleet.outcomes import Outcome
from stillmap.fleet.settings import Settings


class Request(NamedTuple):
    """The job of a fleet.

    Attributes:
        entries: recordings, folders and patterns of them, with their places.
        output: folder or URL of the fleet.
        settings: how the recordings are mapped.
        resolution: edge of a cell in metres.
        jobs: local processes at once.
        scheduler: address of a Dask scheduler; empty: local processes.
    """

    entries: Sequence[Entry]
    output: str
    settings: Settings
    resolution: float
    jobs: int
    scheduler: str = ""


class Reporter(NamedTuple):
    """Where a fleet reports to.

    Attributes:
        say: takes a line about the whole.
        fail: takes a line about a recording or a place that failed.
        progress: takes what is done, how many of how many have ended, and the name of the last one.
    """

    say: Callable[[str], None]
    fail: Callable[[str], None]
    progress: Callable[[str, int, int, str], None]


@dataclass
class Job:
    """A recording on its way through the fleet.

    Attributes:
        source: the recording.
        fingerprint: see `content.fingerprint`.
        info: its summary, see `stillmap info --json`; empty where it cannot be read.
        key: of its result.
        outcome: how inspecting it failed, or mapping it ended; None: not yet.
    """

    source: Source
    fingerprint: str = ""
    info: dict[str, Any] = field(default_factory=dict)
    key: str = ""
    outcome: Outcome | None = None

    @property
    def is_done(self) -> bool:
        """Whether its result is there."""
        return self.outcome is not None and self.outcome.status == "done"

    @property
    def duration(self) -> float:
        """Seconds from its first scan to its last; 0 where it is not known."""
        return float(self.info.get("time", {}).get("duration_s") or 0.0)


class Place(NamedTuple):
    """A place, its recordings, and how merging their results ended; None: too few to merge."""

    name: str
    jobs: list[Job]
    outcome: Outcome | None

    @property
    def is_done(self) -> bool:
        """Whether its result is there."""
        return self.outcome is not None and self.outcome.status == "done"

    @property
    def why(self) -> str:
        """Why there is no result."""
        if self.outcome is not None:
            return self.outcome.why
        n = sum(job.is_done for job in self.jobs)
        return f"merging takes two maps, this place has {n or 'none'}"


class Fleet(NamedTuple):
    """Result of a fleet."""

    jobs: list[Job]
    places: list[Place]

    @property
    def failed(self) -> int:
        """How many recordings and places failed."""
        outcomes = [*(job.outcome for job in self.jobs), *(one.outcome for one in self.places)]
        return sum(one is not None and one.status != "done" for one in outcomes)

    def to_list(self) -> list[dict[str, Any]]:
        """The content of `fleet.json`: an entry for each recording."""
        places = {one.name: one for one in self.places}
        return [_describe(job, places.get(job.source.place or "")) for job in self.jobs]


def _describe(job: Job, place: Place | None) -> dict[str, Any]:
    outcome = job.outcome or Outcome("failed", "was not mapped")
    merged = place is not None and place.is_done
    return {
        "input": job.source.input,
        "name": job.source.name,
        "place": job.source.place,
        "status": "done" if job.is_done else "failed",
        "why": outcome.why,
        "result": f"{RESULTS}/{job.source.name}" if job.is_done else None,
        "cpu_seconds": round(outcome.cpu_seconds, 3),
        "peak_memory_bytes": outcome.peak_memory_bytes,
        "scans": job.info.get("scans"),
        "beams": job.info.get("beams"),
        "duration_s": job.duration,
        "bytes": job.info.get("bytes"),
        "inspect_cpu_seconds": job.info.get("inspect_cpu_seconds"),
        "place_result": f"{PLACES}/{place.name}" if place is not None and merged else None,
        "place_why": "" if place is None or merged else place.why,
    }
