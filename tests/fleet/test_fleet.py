"""What a fleet does with its tasks; what the tasks do is a stand-in's."""

import fcntl
import json
import os
import sys

import pytest

from stillmap.fleet.inputs import Source
from stillmap.fleet.run import Fleet, Job, Place, render_page
from stillmap.fleet.tasks import Outcome


@pytest.fixture
def logs(tmp_path):
    """Makes recordings; what mapping them does is written in them."""

    def make(**contents):
        folder = tmp_path / "logs"
        folder.mkdir(exist_ok=True)
        for name, text in contents.items():
            (folder / f"{name}.clf").write_text(text)
        return folder

    return make


def listed(done):
    assert done.stdout, done.stderr
    return {one["name"]: one for one in json.loads(done.stdout)}


def read_record(folder):
    return json.loads((folder / "run.json").read_text())


def inode(out, name="results/a"):
    return (out / name / "run.json").stat().st_ino


def test_all_are_mapped(stand_in, logs, tmp_path):
    folder, out = logs(a="fine", b="fine"), tmp_path / "out"
    done = stand_in(folder, "-o", out, "--json", "--quiet")
    assert (done.returncode, done.stderr) == (0, "")
    entries = listed(done)
    assert json.loads((out / "fleet.json").read_text()) == list(entries.values())
    entry = entries["a"]
    assert entry["input"] == str(folder / "a.clf")
    assert (entry["status"], entry["place"], entry["why"]) == ("done", None, "")
    assert entry["result"] == "results/a"
    assert entry["cpu_seconds"] > 0
    assert entry["peak_memory_bytes"] > 1 << 20
    assert (entry["scans"], entry["duration_s"]) == (10, 36.0)
    assert sorted(os.listdir(out)) == ["fleet.html", "fleet.json", "results"]
    assert sorted(os.listdir(out / "results")) == ["a", "b"]


def test_options_reach_the_tasks(stand_in, logs, tmp_path):
    folder, out = logs(a="fine", b="fine"), tmp_path / "out"
    words = ["--resolution", 0.1, "--no-odometry", "--threads", 2, "--topic", "/scan 2", "--merge"]
    done = stand_in(folder, "-o", out, "--quiet", *words)
    assert done.returncode == 0, done.stderr
    expected = {"--set=threads=2", '--set=read.topic="/scan 2"', "--set=slam.resolution=0.1"}
    expected |= {"--set=slam.voxel_size=0.1"}
    assert set(read_record(out / "results/a")["flags"]) == {*expected, "--no-odometry"}
    assert set(read_record(out / "places/all")["flags"]) == expected
    before = inode(out), inode(out, "places/all")
    words[words.index(2)] = 3  # threads are no reason to make anything again
    assert stand_in(folder, "-o", out, "--quiet", *words).returncode == 0
    assert (inode(out), inode(out, "places/all")) == before


def test_finished_tasks_are_not_run_again(stand_in, logs, tmp_path):
    folder, out = logs(a="fine", b="bad"), tmp_path / "out"
    first = stand_in(folder, "-o", out, "--quiet", "--json")
    assert first.returncode == 3
    before = inode(out)
    (folder / "b.clf").write_text("fine")
    os.utime(folder / "a.clf", ns=(0, 0))
    again = stand_in(folder, "-o", out, "--quiet", "--json")
    assert again.returncode == 0
    assert listed(again)["a"] == listed(first)["a"]
    assert inode(out) == before


@pytest.mark.parametrize("change", ["recording", "options", "removed", "damaged"])
def test_result_of_something_else_is_made_again(stand_in, logs, tmp_path, change):
    folder, out, words = logs(a="fine"), tmp_path / "out", []
    assert stand_in(folder, "-o", out, "--quiet").returncode == 0
    before = inode(out)
    if change == "recording":
        (folder / "a.clf").write_text("fine ")
    elif change == "options":
        words = ["--resolution", 0.1]
    elif change == "removed":
        (out / "results/a/made.json").unlink()
    else:
        (out / "results/a/made.json").write_text('{"key": 3}')
    assert stand_in(folder, "-o", out, "--quiet", *words).returncode == 0
    assert inode(out) != before
    assert os.listdir(out / "results") == ["a"]


def test_bad_recording_is_named_and_the_rest_goes_on(stand_in, logs, tmp_path):
    folder, out = logs(a="fine", b="bad", c="defect", d="fine"), tmp_path / "out"
    done = stand_in(folder, folder / "missing.clf", "-o", out, "--quiet", "--json")
    assert done.returncode == 3
    entries = listed(done)
    assert {name for name, one in entries.items() if one["status"] == "done"} == {"a", "d"}
    assert entries["b"]["why"] == f"{folder / 'b.clf'}: no two scans"
    assert entries["c"]["why"] == "a defect of stillmap: ValueError(7)"
    assert entries["missing"]["why"] == f"{folder / 'missing.clf'}: does not exist"
    assert entries["b"]["result"] is None
    assert sorted(done.stderr.splitlines()) == [
        f"stillmap: {name}: {entries[name]['why']}" for name in ("b", "c", "missing")
    ]
    page = (out / "fleet.html").read_text()
    assert "2 of 5 recordings mapped" in page
    assert "no two scans" in page
    assert sorted(os.listdir(out / "results")) == ["a", "d"]


def test_places_of_a_manifest_are_merged(stand_in, logs, tmp_path):
    logs(a="fine", b="fine", c="fine", d="bad", e="fine", f="fine")
    rows = [f"logs/{name}.clf,{place}" for name, place in zip("abcdef", "xyxxyz", strict=True)]
    out, path = tmp_path / "out", tmp_path / "robots.csv"
    path.write_text("\n".join(["input,place", *rows]))
    done = stand_in("--manifest", path, "-o", out, "--quiet", "--json")
    assert done.returncode == 3  # because of d
    entries = listed(done)
    assert [entries[name]["place"] for name in "abcdef"] == list("xyxxyz")
    assert entries["a"]["place_result"] == "places/x"
    assert entries["f"]["place_result"] is None
    assert entries["f"]["place_why"] == "merging takes two maps, this place has 1"
    assert read_record(out / "places/x")["merged"] == ["a", "c"]
    assert read_record(out / "places/y")["merged"] == ["b", "e"]
    assert sorted(os.listdir(out / "places")) == ["x", "y"]
    sessions = json.loads((out / "places/x/sessions.json").read_text())
    assert [one["input"] for one in sessions] == [f"{out}/results/a", f"{out}/results/c"]
    page = (out / "fleet.html").read_text()
    assert 'href="places/x/report.html"' in page
    assert "this place has 1" in page


def test_place_is_merged_again_when_one_is_added(stand_in, logs, tmp_path):
    folder, out = logs(a="fine", b="fine"), tmp_path / "out"
    words = (folder, "-o", out, "--quiet", "--merge")
    done = stand_in(*words[:-2], "--merge")
    assert f"stillmap: wrote {out}: open {out}/fleet.html" in done.stderr.splitlines()
    before = inode(out, "places/all")
    assert stand_in(*words).returncode == 0
    assert inode(out, "places/all") == before
    logs(c="fine")
    assert stand_in(*words).returncode == 0
    assert read_record(out / "places/all")["merged"] == ["a", "b", "c"]


def test_place_that_cannot_be_merged(stand_in, logs, tmp_path):
    logs(a="fine", b="fine")
    out, path = tmp_path / "out", tmp_path / "robots.csv"
    path.write_text("input,place\nlogs,refuse\n")
    done = stand_in("--manifest", path, "-o", out, "--quiet", "--json")
    assert done.returncode == 3
    assert done.stderr == "stillmap: place refuse: fewer than two sessions fit\n"
    entries = listed(done)
    assert [one["status"] for one in entries.values()] == ["done", "done"]
    assert entries["a"]["place_why"] == "fewer than two sessions fit"
    assert "fewer than two sessions fit" in (out / "fleet.html").read_text()
    assert os.listdir(out / "places") == []


def test_foreign_folder_is_refused(stand_in, logs, tmp_path):
    folder, out = logs(a="fine"), tmp_path / "out"
    out.mkdir()
    (out / "thesis.tex").write_text("dear")
    done = stand_in(folder, "-o", out)
    assert done.returncode == 2
    assert f"{out}: already holds something" in done.stderr
    assert os.listdir(out) == ["thesis.tex"]


def test_full_disk_stops_the_fleet_with_one_line(stand_in, logs, tmp_path):
    folder, out = logs(a="fine and long", b="full"), tmp_path / "out"
    done = stand_in(folder, "-o", out, "--quiet")
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("stillmap: b: cannot continue: ")
    assert "No space left on device (make room, then continue with the same command)" in line
    assert not (out / "fleet.json").exists()
    (folder / "b.clf").write_text("fine")
    assert stand_in(folder, "-o", out, "--quiet").returncode == 0
    manifest = tmp_path / "m.csv"
    manifest.write_text("".join(["input,place\n", *(f"{folder}/{x}.clf,full\n" for x in "ab")]))
    done = stand_in("--manifest", manifest, "-o", out, "--quiet")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("stillmap: full: cannot continue: ")
    assert os.listdir(out / "places") == []


@pytest.mark.parametrize("missing", ["distributed", "cryptography", "fsspec"])
def test_a_missing_library_is_named_in_one_line(call, logs, tmp_path, monkeypatch, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    done = call("fleet", logs(a="fine"), "-o", tmp_path / "out", "--jobs", 1, "--quiet")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert f"needs {missing} to be run" in line or f"needs {missing} to be read" in line
    assert "pip install '.[fleet]'" in line


def test_two_fleets_in_one_folder(stand_in, logs, tmp_path):
    folder, out = logs(a="fine"), tmp_path / "out"
    out.mkdir()
    with (out / ".lock").open("ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        done = stand_in(folder, "-o", out)
    assert done.returncode == 2
    assert done.stderr == (
        f"stillmap: {out}: another fleet is writing there (wait for it, or stop it)\n"
    )
    assert os.listdir(out) == [".lock"]
    assert stand_in(folder, "-o", out, "--quiet").returncode == 0
    assert sorted(os.listdir(out)) == ["fleet.html", "fleet.json", "results"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "names no recording"),
        (["nothing*"], "matches no file or folder"),
        (["logs", "--jobs", 0], "--jobs must be 1 to 1024"),
        (["logs", "--jobs", 2, "--scheduler", "tcp://a:1"], "exclude each other"),
        (["logs", "--merge", "--manifest", "m.csv"], "--merge is for INPUTs"),
        (["--manifest", "m.csv"], "m.csv: cannot be read"),
        (["logs", "--poses", "a.tum"], "--poses FILE is for one recording"),
        (["logs", "--set", "em.pior=1"], "nearest: 'em.prior'"),
        (["logs", "--config", "none.toml"], "none.toml: cannot be read"),
        (["nothing://a/b"], "is no path or URL"),
    ],
)
def test_bad_calls_make_nothing(call, logs, tmp_path, monkeypatch, words, message):
    logs(a="fine")
    monkeypatch.chdir(tmp_path)
    done = call("fleet", *words, "-o", "out")
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert message in line
    assert not (tmp_path / "out").exists()


def test_names_of_results_stay(stand_in, logs, tmp_path):
    folder, out = logs(b="fine"), tmp_path / "out"
    earlier = tmp_path / "earlier"
    earlier.mkdir()
    (earlier / "b.clf").write_text("fine")
    assert stand_in(folder, "-o", out, "--quiet").returncode == 0
    before = inode(out, "results/b")
    done = stand_in(earlier, folder, "-o", out, "--quiet", "--json")
    results = {one["input"]: one["result"] for one in json.loads(done.stdout)}
    assert results == {str(earlier / "b.clf"): "results/b-2", str(folder / "b.clf"): "results/b"}
    assert inode(out, "results/b") == before


def test_names_of_files_are_no_markup():
    evil = '<script>alert("1")</script>'
    summary = {"warnings": [evil], "notes": [evil], "quality": {}, "area": {}, "sessions": []}
    done = Job(Source(f"/{evil}", "a", evil), Outcome("done", summary=summary))
    bad = Job(Source("/b", evil, evil), Outcome("failed", evil))
    page = render_page(Fleet([done, bad], [Place(evil, [done, bad], Outcome("too few", evil))]))
    assert "<script" not in page
    assert page.count("&lt;script&gt;") >= 6
