"""File names that are no UTF-8, plain locales, settings of notebooks: none of it ends a run."""

import json
import os
import shutil
from pathlib import Path

import pytest
from flat import list_files
from maps import QUICK
from result_contents import FILES

NAME = os.fsdecode(b"h\xe4ll")  # of Latin-1
PLAIN = {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.fixture
def folder(tmp_path) -> Path:
    try:
        (tmp_path / NAME).mkdir()
    except OSError:
        pytest.skip("this file system wants names in UTF-8")
    return tmp_path / NAME


def test_names_that_are_no_utf8(stillmap, call, room, folder):
    recording, out = folder / f"{NAME}-in", folder / f"{NAME}-out"
    shutil.copytree(room, recording)
    done = stillmap("map", recording, "-o", out, "--quiet", "--json", *QUICK)
    assert (done.returncode, done.stderr) == (0, "")
    assert list_files(out) >= FILES
    assert json.loads(done.stdout)["output"] == str(out)
    assert json.loads((out / "run.json").read_text(encoding="utf-8"))["input"]["path"] == str(
        recording
    )
    assert r"\udce4" in (out / "report.html").read_text(encoding="utf-8")
    for target in ("clean", "clean.log", "clean.mcap"):  # which finds the recording by run.json
        done = call("filter", out, "-o", folder / f"{NAME}{target}", "--quiet")
        assert (done.returncode, done.stderr) == (0, "")
    for target in ("beams.parquet", "a.bag", "a.mcap"):
        pytest.importorskip("pyarrow")
        done = call("convert", out, "-o", folder / f"{NAME}{target}", "--quiet")
        assert (done.returncode, done.stderr) == (0, "")


def test_places_of_names_that_are_no_utf8(call, room, mapped, folder):
    sessions = [folder / f"{NAME}-{number}" for number in "12"]
    for source, one in zip((mapped, room), sessions, strict=True):
        shutil.copytree(source, one)
    done = call("merge", *sessions, "-o", folder / "place", "--quiet", *QUICK)
    assert (done.returncode, done.stderr) == (0, "")
    records = json.loads((folder / "place" / "sessions.json").read_text(encoding="utf-8"))
    assert [one["name"] for one in records] == [one.name for one in sessions]
    done = call("filter", folder / "place", "-o", folder / "clean", "--quiet")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    "environment",
    [
        {"LC_ALL": "nowhere.ISO-8859-1", **PLAIN, "MPLBACKEND": "nonsense"},
        {"PYTHONIOENCODING": "ascii:strict"},
    ],
    ids=lambda given: "-".join(given.values()),
)
def test_environment(stillmap, room, tmp_path, environment):
    out = tmp_path / "höll"
    done = stillmap("map", room, "-o", out, *QUICK, env={**os.environ, **environment})
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert list_files(out) >= FILES
