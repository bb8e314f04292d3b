"""`stillmap view`: a result in the browser, or its report."""

import os
import re
import shutil
import signal
import sys
import time
import urllib.error
import urllib.request

import pytest

from stillmap.core import errors
from stillmap.core.errors import install_command

SCREENS = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")


@pytest.fixture
def report(tmp_path):
    """A folder with a report alone."""
    out = tmp_path / "a result"
    out.mkdir()
    (out / "report.html").write_text("<!doctype html>")
    return out


@pytest.fixture
def elsewhere(monkeypatch):
    """No screen, no browser."""
    for name in SCREENS:
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def without_viser(monkeypatch):
    """The extra is not installed."""

    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(errors, "import_module", missing)


@pytest.fixture
def browser(tmp_path):
    """An environment whose browser notes what it is to open, and the note."""
    program, note = tmp_path / "browser", tmp_path / "opened"
    program.write_text(f'#!/bin/sh\necho "$1" > "{note}.part"\nmv "{note}.part" "{note}"\n')
    program.chmod(0o755)
    return {**os.environ, "BROWSER": f"{program} %s"}, note


def served(process):
    """Its address, as soon as it says so, and what it said before."""
    said = ""
    for line in process.stderr:
        said += line
        if found := re.search(r"http://127\.0\.0\.1:\d+/[\w-]{32}", line):
            return found[0], said
    raise AssertionError(said)


def ended(process, number=signal.SIGINT):
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err


def without_a_screen():
    return {name: value for name, value in os.environ.items() if name not in SCREENS}


@pytest.mark.skipif(sys.platform == "darwin", reason="there is always a screen")
def test_result_is_served_until_ctrl_c(start, mapped):
    pytest.importorskip("viser")
    process = start("view", mapped, env=without_a_screen())
    address, said = served(process)
    with urllib.request.urlopen(address, timeout=10) as page:
        assert page.status == 200
    assert "no browser found" in said
    assert "without beams" not in said
    assert ended(process) == (0, "", "")


def test_sigterm_ends_at_once(start, mapped):
    pytest.importorskip("viser")
    process = start("view", mapped, env=without_a_screen())
    served(process)
    assert ended(process, signal.SIGTERM) == (143, "", "")


def test_opens_browser_of_the_environment(start, mapped, browser):
    pytest.importorskip("viser")
    environment, note = browser
    process = start("view", mapped, "--no-beams", env=environment)
    address, said = served(process)
    assert "no browser" not in said
    for _ in range(200):
        if note.exists():
            break

        time.sleep(0.05)
    opened = note.read_text().rstrip("\n")
    assert opened == address
    with urllib.request.urlopen(opened, timeout=10) as page:
        assert page.status == 200
    without_token = address.rpartition("/")[0]
    with pytest.raises(urllib.error.HTTPError, match="403") as caught:
        urllib.request.urlopen(without_token, timeout=10)
    caught.value.close()
    assert ended(process)[0] == 0


def test_missing_recording_shows_no_beams(start, mapped, room, tmp_path):
    pytest.importorskip("viser")
    out = shutil.copytree(mapped, tmp_path / "out")
    record = (out / "run.json").read_text()
    (out / "run.json").write_text(record.replace(str(room), "/nowhere"))
    process = start("view", out, env=without_a_screen())
    _, said = served(process)
    assert "without beams: /nowhere: does not exist" in said
    assert ended(process)[0] == 0


def test_damaged_result_is_refused(call, mapped, tmp_path):
    pytest.importorskip("viser")
    out = shutil.copytree(mapped, tmp_path / "out")
    (out / "map.npz").write_bytes(b"nonsense")
    done = call("view", out, "--no-beams")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "map.npz" in done.stderr


@pytest.mark.usefixtures("elsewhere", "without_viser")
@pytest.mark.skipif(sys.platform == "darwin", reason="there is always a screen")
def test_report_without_the_extra(call, report):
    done = call("view", report)
    assert (done.returncode, done.stdout) == (0, "")
    first, second = done.stderr.splitlines()
    assert install_command("viewer") in first
    assert str(report / "report.html") in second


def test_opens_report_in_browser(stillmap, report, browser):
    environment, note = browser
    done = stillmap("view", report, "--report", env=environment)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert note.read_text() == f"{(report / 'report.html').as_uri()}\n"


def test_non_result_is_refused(call, tmp_path):
    (tmp_path / "results").mkdir()
    (tmp_path / "file").write_text("")
    for name, said in (
        ("results", "is no result"),
        ("file", "is no result"),
        ("result", "does not exist"),
    ):
        done = call("view", tmp_path / name)
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.startswith(f"stillmap: {tmp_path / name}: {said}")
        assert done.stderr.count("\n") == 1
