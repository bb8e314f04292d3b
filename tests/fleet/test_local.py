"""Fleets of real recordings on this machine: equal to maps by hand, whatever happens."""

import json
import os
import re
import signal
from html.parser import HTMLParser

import pytest
from fleets import NAMES, children_of, is_alive, unfinished, wait_until
from marks import slow_params
from result_contents import contents

from stillmap.cli.parser import COMMANDS


@pytest.fixture(scope="module")
def fleet(recordings, start, tmp_path_factory):
    """The folder of a fleet of the recordings and of a damaged one, and what was printed."""
    out = tmp_path_factory.mktemp("fleet") / "out"
    damaged = out.parent / "damaged.bag"
    damaged.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    process = start("fleet", recordings, damaged, "-o", out)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 3, err
    return out, err


def test_results_equal_those_by_hand(fleet, by_hand):
    out, _ = fleet
    assert sorted(os.listdir(out / "results")) == sorted(NAMES)
    for name in NAMES:
        assert contents(out / "results" / name) == by_hand[name], name


def test_only_what_is_promised_is_left(fleet):
    out, _ = fleet
    assert unfinished(out) == set()
    assert sorted(os.listdir(out.parent)) == ["damaged.bag", "out"]


def test_damaged_one_is_named(fleet):
    out, err = fleet
    (entry,) = [one for one in json.loads((out / "fleet.json").read_text()) if one["why"]]
    assert (entry["name"], entry["status"], entry["result"]) == ("damaged", "failed", None)
    assert f"stillmap: damaged: {entry['why']}" in err.splitlines()


def test_cost_is_noted(fleet):
    out, _ = fleet
    for one in json.loads((out / "fleet.json").read_text()):
        if one["status"] == "done":
            run = json.loads((out / one["result"] / "run.json").read_text())
            peak = max(run["peak_memory_bytes"].values())
            assert peak <= one["peak_memory_bytes"] < 2 * peak
            assert one["cpu_seconds"] > sum(run["cpu_seconds"].values())
            assert one["inspect_cpu_seconds"] > 0
            assert one["duration_s"] > 1


class _Page(HTMLParser):
    def __init__(self):
        super().__init__()
        self.sources, self.links = [], []

    def handle_starttag(self, _tag, attributes):
        about = dict(attributes)
        self.sources += [about[key] for key in ("src", "data", "srcset") if key in about]
        self.links += [about["href"]] if "href" in about else []


def test_page_is_self_contained(fleet):
    out, _ = fleet
    text = (out / "fleet.html").read_text()
    page = _Page()
    page.feed(text)
    assert len(page.sources) == len(NAMES)
    assert all(one.startswith("data:image/png;base64,") for one in page.sources)
    assert sorted(page.links) == [f"results/{name}/report.html" for name in sorted(NAMES)]
    assert all((out / link).is_file() for link in page.links)
    assert "3 of 4 recordings mapped" in text
    assert not re.search(r"url\(|@import|<script", text)
    assert "prefers-color-scheme: dark" in text


def begin(start, inputs, out):
    """A fleet of which one recording is mapped, and its processes."""
    process = start("fleet", *inputs, "-o", out, "--jobs", 1)
    wait_until(lambda: list(out.glob("results/*/run.json")))
    return process, children_of(process.pid)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "status"), [("SIGINT", 130), ("SIGKILL", -9), *slow_params(("SIGTERM", 143))]
)
def test_stopped_and_continued(start, recordings, by_hand, tmp_path, number, status):
    out, names = tmp_path / "out", NAMES[:2]
    inputs = [recordings / name for name in names]
    process, children = begin(start, inputs, out)
    process.send_signal(getattr(signal, number))
    _, err = process.communicate(timeout=30)
    assert process.returncode == status
    assert "Traceback" not in err
    if number != "SIGKILL":
        assert "continue with the same command: stillmap fleet" in err
        assert unfinished(out) == set()
    wait_until(lambda: not any(map(is_alive, children)), 10)
    done = {one.name: one.stat().st_ino for one in (out / "results").iterdir()}
    assert all((out / "results" / name / "run.json").is_file() for name in done)
    again = start("fleet", *inputs, "-o", out, "--quiet")
    assert again.communicate(timeout=60) == ("", "")
    assert again.returncode == 0
    for name in names:
        assert contents(out / "results" / name) == by_hand[name]
    for name, inode in done.items():
        assert (out / "results" / name).stat().st_ino == inode  # not mapped again
    assert unfinished(out) == set()


@pytest.mark.slow
@pytest.mark.skipif("merge" not in COMMANDS, reason="stillmap merge is no command here")
def test_sessions_of_one_place_are_merged(start, recordings, tmp_path):
    out = tmp_path / "out"
    process = start("fleet", recordings, "-o", out, "--merge", "--json", "--quiet")
    printed, err = process.communicate(timeout=300)
    assert process.returncode in (0, 3), err
    (why,) = {one["place_why"] for one in json.loads(printed)}
    if process.returncode == 0:
        assert (out / "places/all/sessions.json").is_file()
    else:
        assert why
    assert unfinished(out) == set()
