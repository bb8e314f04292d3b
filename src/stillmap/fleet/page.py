"""`fleet.html`: one self-contained page about a fleet, a card for each place and recording."""

from typing import Any
from urllib.parse import quote

from stillmap.core.version import package_version
from stillmap.fleet.artifacts import PLACES, RESULTS
from stillmap.fleet.jobs import Fleet, Job, Place
from stillmap.fleet.outcomes import Outcome
from stillmap.results.report.formatting import format_bytes, format_duration
from stillmap.results.report.page import environment


def render_page(fleet: Fleet) -> str:
    """The page: no outside request, no script; links lead to the reports beside it."""
    failed = [job for job in fleet.jobs if not job.is_done]
    data = {
        "totals": _totals(fleet),
        "failed": [(job.source.name, _why(job)) for job in failed],
        "places": [_place_card(place) for place in fleet.places],
        "recordings": [_recording_card(job) for job in fleet.jobs if job.is_done],
        "version": package_version(),
    }
    return environment().get_template("fleet.html.j2").render(data)


def _totals(fleet: Fleet) -> dict[str, Any]:
    done = [job for job in fleet.jobs if job.is_done]
    outcomes = [job.outcome for job in done if job.outcome is not None]
    seconds = sum(job.duration for job in done)
    cpu = sum(outcome.cpu_seconds for outcome in outcomes)
    return {
        "recordings": len(fleet.jobs),
        "done": len(done),
        "duration": seconds,
        "bytes": sum(int(job.info.get("bytes") or 0) for job in done),
        "cpu": cpu,
        "cpu_per_hour": cpu / seconds * 3600 if seconds else None,
        "memory": max((outcome.peak_memory_bytes for outcome in outcomes), default=0),
    }


def _why(job: Job) -> str:
    return job.outcome.why if job.outcome is not None else "was not mapped"


def _recording_card(job: Job) -> dict[str, Any]:
    outcome = job.outcome or Outcome("failed")
    card = _card(job.source.name, f"{RESULTS}/{job.source.name}", outcome)
    facts = [
        ("Recording", f"{format_duration(job.duration)}, {int(job.info['scans']):,} scans"),
        *card["facts"],
        *([("Place", job.source.place)] if job.source.place else []),
    ]
    return {**card, "input": job.source.input, "facts": facts}


def _place_card(place: Place) -> dict[str, Any]:
    if not place.is_done or place.outcome is None:
        names = [job.source.name for job in place.jobs]
        card = _card(place.name, "", Outcome("failed"))
        return {**card, "link": "", "facts": (), "why": place.why, "sessions": names}
    sessions = place.outcome.found.get("sessions", ())
    return {
        **_card(place.name, f"{PLACES}/{place.name}", place.outcome),
        "sessions": [one["name"] for one in sessions if one["accepted"]],
        "refused": [(one["name"], one["why"]) for one in sessions if not one["accepted"]],
    }


def _card(name: str, folder: str, outcome: Outcome) -> dict[str, Any]:
    found = outcome.found
    return {
        "name": name,
        "why": "",
        "map": found.get("map"),
        "link": f"{quote(folder)}/report.html",
        "warnings": found.get("warnings", ()),
        "notes": found.get("notes", ()),
        "facts": [*_figures(found), *_cost(outcome)],
        "sessions": (),
        "refused": (),
        "input": "",
    }


def _figures(found: dict[str, Any]) -> list[tuple[str, str]]:
    area, quality = found.get("area", {}).get("known"), found.get("quality", {})
    parts = [f"{name} {quality[name]:.0f}" for name in ("labels", "geometry") if quality.get(name)]
    rated = f"{quality['overall']:.0f} of 100" if quality.get("overall") is not None else "unknown"
    changes = found.get("changes", 0)
    return [
        *([("Known area", f"{area:,.0f} m²")] if area else []),
        ("Quality", f"{rated} ({', '.join(parts)})" if parts else rated),
        *([("Changed places", str(changes))] if changes else []),
    ]


def _cost(outcome: Outcome) -> list[tuple[str, str]]:
    memory = format_bytes(outcome.peak_memory_bytes)
    return [("Cost", f"{format_duration(outcome.cpu_seconds)} CPU, {memory}")]
