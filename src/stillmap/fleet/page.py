"""`fleet.html`: one self-contained page about a fleet, a card for each place and recording."""

from typing import Any

from stillmap.fleet.jobs import Fleet
from stillmap.results.report import template


def render_page(fleet: Fleet) -> str:
    """The page: no outside request, no script; links lead to the reports beside it."""
    return template.render_page({"fleet": fleet, "totals": _totals(fleet)}, "fleet.html.j2")


def _totals(fleet: Fleet) -> dict[str, Any]:
    done = [job.outcome for job in fleet.jobs if job.outcome.is_done]
    seconds = sum(outcome.summary.get("duration_s") or 0.0 for outcome in done)
    cpu = sum(outcome.cpu_seconds for outcome in done)
    return {
        "recordings": len(fleet.jobs),
        "done": len(done),
        "duration": seconds,
        "bytes": sum(outcome.summary.get("bytes") or 0 for outcome in done),
        "cpu": cpu,
        "cpu_per_hour": cpu / seconds * 3600 if seconds else None,
        "memory": max((outcome.peak_memory_bytes for outcome in done), default=0),
    }
