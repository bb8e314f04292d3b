"""Several inputs of one command: parts of one run are joined, sessions are told apart."""

import json
import shlex
from dataclasses import replace

import numpy as np
import pytest
from flat import files_of
from refusals import refused

import stillmap
from stillmap.core.errors import InputError
from stillmap.io import read, writers
from stillmap.pipeline import result
from stillmap.pipeline.em_loop import iterate
from stillmap.prepare.options import ReadOptions
from stillmap.prepare.time_window import TimeWindow, select_time

QUICK = ("--set", "em.max_iterations=1", "--quiet")
CUTS = ((0, 13), (14, 24), (25, 39))  # scans of the room


def cut_folder(room, folder):
    """The room in three recording folders, a little out of order."""
    whole = read(room)
    seconds = (whole.stamp_ns - whole.stamp_ns[0]) / 1e9
    out = []
    for number, (first, last) in enumerate(CUTS):
        window = TimeWindow(ReadOptions(start=seconds[first] or None, end=seconds[last]))
        path = folder / f"part_{number}"
        part = select_time(whole, window)
        writers.write(replace(part, source=replace(part.source, part=None)), path)
        out.append(path)
    return [out[k] for k in (2, 0, 1)]


def cut_log(room, folder):
    """The room as a CARMEN log, and its lines in two files, as a recorder splits them."""
    whole = folder / "whole.log"
    writers.write(read(room), whole)
    lines = whole.read_text().splitlines(keepends=True)
    half = len(lines) // 2
    (folder / "log_0.log").write_text("".join(lines[:half]))
    (folder / "log_1.log").write_text("".join(lines[half:]))
    return whole, [folder / "log_1.log", folder / "log_0.log"]


@pytest.fixture
def day_after(room, tmp_path):
    """Another recording of the room, a day later."""
    recording = read(room)
    path = tmp_path / "tuesday"
    later = recording.stamp_ns + 86400 * 10**9
    writers.write(replace(recording, stamp_ns=later), path)
    return path


def contents(folder):
    """All files but the record and the report, which name the inputs and times."""
    named = ("run.json", "report.html")
    return {name: data for name, data in files_of(folder).items() if name not in named}


@pytest.mark.parametrize("form", ["folder", "log"])
def test_the_map_of_parts_is_that_of_the_whole(call, room, tmp_path, form):
    if form == "folder":
        whole, parts = room, cut_folder(room, tmp_path)
    else:
        whole, parts = cut_log(room, tmp_path)
    assert call("map", whole, "-o", tmp_path / "a", *QUICK).returncode == 0
    done = call("map", *parts, "-o", tmp_path / "b", *QUICK)
    assert done.returncode == 0, done.stderr
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    one, other = (json.loads((tmp_path / name / "run.json").read_text())["input"] for name in "ab")
    assert "parts" not in one
    assert sum(part["scans"] for part in other["parts"]) == 40
    starts = [part["first_stamp_ns"] for part in other["parts"]]
    assert starts == sorted(starts)
    assert other["path"] == other["parts"][0]["path"]


@pytest.fixture
def mapped_parts(call, room, tmp_path):
    parts = cut_folder(room, tmp_path)
    done = call("map", *parts, "-o", tmp_path / "out", *QUICK)
    assert done.returncode == 0, done.stderr
    return tmp_path / "out", parts


def test_a_result_of_parts_finds_them_again(call, room, mapped_parts, tmp_path):
    out, parts = mapped_parts
    whole, loaded = read(room), stillmap.load(out)
    np.testing.assert_array_equal(loaded.recording.points, whole.points)
    kept = loaded.hit & ~(loaded.p_static < 0.5)
    for name in ("clean", "clean.clf", "clean.mcap"):
        done = call("filter", out, "-o", tmp_path / name, "--json", "--quiet")
        assert done.returncode == 0, done.stderr
        assert len(json.loads(done.stdout)["parts"]) == 3
        filtered = read(tmp_path / name)
        np.testing.assert_array_equal(filtered.stamp_ns, whole.stamp_ns)
        assert filtered.hit.sum() == kept.sum()
    assert call("convert", out, "-o", tmp_path / "out.mcap", "--quiet").returncode == 0
    in_order = [parts[k] for k in (1, 2, 0)]
    moved = [path.rename(path.with_name(f"moved_{path.name}")) for path in in_order]
    refused(call("filter", out, "-o", tmp_path / "again"), parts[1], "does not exist", "--input")
    again = stillmap.load(out, recording=moved)
    np.testing.assert_array_equal(again.recording.points, whole.points)
    done = call("filter", out, "-o", tmp_path / "again", "--input", room, "--quiet")
    assert done.returncode == 0, done.stderr
    with pytest.raises(InputError, match="is not the recording that was mapped"):
        _ = stillmap.load(out, recording=moved[:1]).recording


def test_the_window_counts_from_the_start_of_the_whole(call, room, tmp_path):
    window = ("--from", "1.5", "--to", "4")
    parts = cut_folder(room, tmp_path)
    assert call("map", room, "-o", tmp_path / "a", *window, *QUICK).returncode == 0
    done = call("map", *parts, "-o", tmp_path / "b", *window, *QUICK)
    assert done.returncode == 0, done.stderr
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    np.testing.assert_array_equal(
        stillmap.load(tmp_path / "b").recording.points,
        stillmap.load(tmp_path / "a").recording.points,
    )


def test_an_interrupted_run_of_parts_continues(call, room, tmp_path, monkeypatch):
    def stopped(*args, **how):
        yield next(iterate(*args, **how))
        raise KeyboardInterrupt

    words = ("--set", "em.max_iterations=2", "--set", "em.tolerance=0", "--set", "em.patience=9")
    words += ("--set", "em.label_tolerance=0")
    parts = cut_folder(room, tmp_path)
    assert call("map", room, "-o", tmp_path / "a", *words).returncode == 0
    with monkeypatch.context() as patch:
        patch.setattr(result, "iterate", stopped)
        done = call("map", *parts, "-o", tmp_path / "b", *words)
    assert done.returncode == 130
    told = done.stderr.partition("continue after iteration 1: stillmap ")[2].partition("\n")[0]
    assert all(str(part) in told for part in parts)
    fewer = call("map", *parts[1:], "-o", tmp_path / "b", *words, "--resume", "--quiet")
    refused(fewer, "cannot be resumed", "another recording")
    done = call(*shlex.split(told))
    assert done.returncode == 0, done.stderr
    assert "continues after iteration 1" in done.stderr
    assert "3 parts of one run" in done.stderr
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_sessions_are_refused_and_merge_named(call, room, day_after, tmp_path, nothing_left):
    done = call("map", day_after, room, "-o", tmp_path / "out", *QUICK)
    refused(done, f"{day_after}: does not follow {room}", f"stillmap merge {room} {day_after}")
    nothing_left("tuesday")
    both = json.loads(call("info", room, day_after, "--json").stdout)
    assert [one["scans"] for one in both["recordings"]] == [40, 40]


def test_given_poses_are_those_of_all_parts(call, room, tmp_path):
    parts = cut_folder(room, tmp_path)
    assert call("map", room, "-o", tmp_path / "a", *QUICK).returncode == 0
    poses = tmp_path / "a" / "trajectory.tum"
    done = call("map", *parts, "-o", tmp_path / "b", "--poses", poses, *QUICK)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "b" / "trajectory.tum").read_bytes() == poses.read_bytes()
