"""The folder that `stillmap map` writes to: what is replaced and what is refused."""

import errno
import os
import shlex
import shutil

import pytest
from flat import list_files
from maps import QUICK, TWO_ITERATIONS
from refusals import refused
from result_contents import FILES

import stillmap.results.writer


def test_non_empty_folder_is_refused(call, room, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    refused(call("map", room, "-o", out, *QUICK), out, "--overwrite")
    for more in ("--overwrite", "--resume"):  # only results are replaced
        refused(call("map", room, "-o", out, more, *QUICK), out, "run.json")
    assert list_files(out) == {"mine.txt"}
    (out / "run.json").write_text("")
    done = call("map", room, "-o", out, "--overwrite", *QUICK)
    assert done.returncode == 0
    assert list_files(out) >= FILES
    assert "mine.txt" not in list_files(out)


def test_recording_is_not_overwritten(call, room, tmp_path):
    recording = tmp_path / "in" / "room"
    shutil.copytree(room, recording)
    (tmp_path / "in" / "run.json").write_text("")
    (recording / "run.json").write_text("")  # as if they were results, too
    before = list_files(recording)
    for given in (recording, recording / "recording.json"):
        done = call("map", given, "-o", recording, "--overwrite", *QUICK)
        refused(done, "is the recording itself")
    for more in ("--overwrite", "--resume"):
        refused(call("map", recording, "-o", tmp_path / "in", more, *QUICK), "holds the recording")
    assert list_files(recording) == before


@pytest.mark.parametrize("step", ["render_report", "write_labels", "write_json"])
def test_failure_at_the_end_keeps_what_was_computed(call, room, tmp_path, monkeypatch, step):
    """One line says how to go on; the same command with --resume does."""
    out, words = tmp_path / "out", ("--quiet", *TWO_ITERATIONS)

    def fail(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(f"stillmap.results.writer.{step}", fail)
        done = call("map", room, "-o", out, *words)
    refused(
        done, f"{out}: cannot be written: No space left on device (continue after iteration 2: "
    )
    command = shlex.split(done.stderr.partition("iteration 2: ")[2].rstrip(")\n"))
    assert command == ["stillmap", "map", str(room), "-o", str(out), *words, "--resume"]
    assert list_files(tmp_path) >= {".out.resume/iteration-2/checkpoint.json"}
    done = call("map", room, "-o", out, *TWO_ITERATIONS, "--resume")
    assert done.returncode == 0
    assert "continues after iteration 2" in done.stderr
    assert list_files(out) >= FILES
    assert os.listdir(tmp_path) == ["out"]


def test_defect_at_the_end_keeps_what_was_computed(call, room, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("a defect")

    monkeypatch.setattr("stillmap.results.writer.render_report", fail)
    done = call("map", room, "-o", tmp_path / "out", "--quiet", *QUICK)
    assert done.returncode == 1
    assert "stillmap: continue after iteration 1: stillmap map" in done.stderr
    assert "this is a defect of stillmap" in done.stderr
    assert list_files(tmp_path) >= {".out.resume/iteration-1/checkpoint.json"}


def test_folder_that_appears_meanwhile(call, room, tmp_path, monkeypatch):
    """Neither that nor what was computed is lost."""
    out, save = tmp_path / "out", stillmap.results.writer.render_report

    def render(*words):
        out.mkdir()
        (out / "mine").write_text("mine")
        return save(*words)

    monkeypatch.setattr("stillmap.results.writer.render_report", render)
    done = call("map", room, "-o", out, "--quiet", *QUICK)
    refused(done, "already holds something", "continue after iteration 1: stillmap map")
    assert list_files(out) == {"mine"}
