"""How many tasks run at once, and the page of a fleet."""

import pytest

from stillmap.fleet.inputs import Source
from stillmap.fleet.jobs import Fleet, Job, Place
from stillmap.fleet.memory import estimate_memory, fitting_jobs, machine_memory
from stillmap.fleet.outcomes import Outcome
from stillmap.fleet.page import render_page


@pytest.mark.parametrize(
    ("estimates", "jobs", "memory", "expected"),
    [
        ([1, 1, 1, 1], 3, 100, 3),
        ([5, 1, 1, 1], 4, 7, 3),  # 5 + 1 + 1
        ([5, 5, 1, 1], 4, 9, 1),  # the two largest may meet
        ([50], 4, 7, 1),  # one alone always runs
        ([50, 1], 4, 7, 1),
        ([2] * 100, 8, 11, 5),
    ],
)
def test_jobs_that_fit(estimates, jobs, memory, expected):
    assert fitting_jobs(estimates, jobs, memory) == expected


def info(**changes):
    ranges = {"min": 0.1, "median": 3.0, "p99": 20.0, "max": 80.0}
    found = {"scans": 1000, "beams": 10**6, "dimension": 2, "hit_ranges_m": ranges}
    return {**found, **changes}


@pytest.mark.parametrize(
    ("recording", "resolution", "peak"),
    [  # measured, bytes
        (info(scans=4354, beams=783_720), 0.05, 257e6),
        (info(scans=1000, beams=1_081_000), 0.05, 249e6),
        (info(scans=100_000, beams=18_000_000), 0.05, 2788e6),
        (info(scans=120, beams=6_912_000, dimension=3), 0.05, 399e6),
        (info(scans=40, beams=1_200_000, dimension=3), 0.05, 314e6),
    ],
)
def test_estimate_is_an_upper_figure(recording, resolution, peak):
    assert peak < estimate_memory(recording, resolution) < 2.5 * peak


def test_estimate_of_a_recording_without_hits():
    assert estimate_memory(info(hit_ranges_m=None), 0.05) < estimate_memory(info(), 0.05)
    assert estimate_memory(info(), 0.05) < estimate_memory(info(), 0.02)


def test_memory_of_this_machine():
    assert 1 << 28 < machine_memory() < 1 << 50


def test_names_of_files_are_no_markup():
    evil = '<script>alert("1")</script>'
    found = {"map": None, "warnings": [evil], "notes": [evil], "quality": {"overall": None}}
    done = Job(Source(f"/{evil}", "a", evil), info={"scans": 3}, outcome=Outcome("done", "", found))
    bad = Job(Source("/b", evil, evil), outcome=Outcome("failed", evil))
    place = Place(evil, [done, bad], None)
    page = render_page(Fleet([done, bad], [place]))
    assert "<script" not in page
    assert page.count("&lt;script&gt;") >= 6
