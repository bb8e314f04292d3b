"""What a fleet does with its tasks; what the tasks do is a stand-in's."""

import errno
import fcntl
import json
import os

import pytest
from fleets import unfinished

from stillmap.fleet import phases, storage

pytestmark = pytest.mark.usefixtures("stand_in")


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


def attempts(folder, name):
    path = folder / f"{name}.attempts"
    return int(path.read_text()) if path.exists() else 0


def test_all_are_mapped(call, logs, tmp_path):
    folder, out = logs(a="fine", b="fine"), tmp_path / "out"
    done = call("fleet", folder, "-o", out, "--json", "--quiet", "--jobs", 2)
    assert (done.returncode, done.stderr) == (0, "")
    found = listed(done)
    assert json.loads((out / "fleet.json").read_text()) == list(found.values())
    assert found["a"]["input"] == str(folder / "a.clf")
    assert (found["a"]["status"], found["a"]["place"], found["a"]["why"]) == ("done", None, "")
    assert found["a"]["result"] == "results/a"
    assert found["a"]["cpu_seconds"] > 0
    assert found["a"]["peak_memory_bytes"] > 1 << 20
    assert (found["a"]["scans"], found["a"]["duration_s"], found["a"]["bytes"]) == (10, 36.0, 4)
    assert unfinished(out) == set()


def test_options_reach_the_tasks(call, logs, tmp_path):
    words = ["--resolution", 0.1, "--no-odometry", "--threads", 2, "--topic", "/scan 2"]
    done = call("fleet", logs(a="fine"), "-o", tmp_path / "out", "--quiet", *words)
    assert done.returncode == 0, done.stderr
    given = json.loads((tmp_path / "out/results/a/run.json").read_text())["words"]
    expected = ["--set=threads=2", '--set=read.topic="/scan 2"', "--set=slam.resolution=0.1"]
    expected += ["--set=slam.voxel_size=0.1", "--no-odometry"]
    assert given[given.index("--quiet") + 1 :] == expected


def test_options_reach_the_merging_of_places(call, logs, tmp_path):
    folder, out = logs(a="fine", b="fine"), tmp_path / "out"

    def merged(*words):
        done = call("fleet", folder, "-o", out, "--quiet", "--merge", *words)
        assert done.returncode == 0, done.stderr
        given = json.loads((out / "places/all/run.json").read_text())["words"]
        return given[given.index("--quiet") + 1 :]

    assert merged() == ["--set=threads=1"]
    words = ["--resolution", 0.1, "--no-odometry"]
    expected = ["--set=threads=2", "--set=slam.resolution=0.1", "--set=slam.voxel_size=0.1"]
    assert merged("--threads", 2, *words) == expected
    assert merged("--threads", 3, *words) == expected  # which is no reason to merge again


def test_finished_tasks_are_not_run_again(call, logs, tmp_path):
    folder, out = logs(a="fine", b="bad"), tmp_path / "out"
    assert call("fleet", folder, "-o", out, "--quiet").returncode == 3
    before = (out / "results/a/run.json").stat()
    (folder / "b.clf").write_text("fine")
    assert call("fleet", folder, "-o", out, "--quiet").returncode == 0
    assert os.path.samestat(before, (out / "results/a/run.json").stat())
    assert (attempts(folder, "a"), attempts(folder, "b")) == (1, 2)


@pytest.mark.slow
@pytest.mark.parametrize("change", ["recording", "options", "result", "removed", "label"])
def test_result_of_something_else_is_made_again(call, logs, tmp_path, change):
    folder, out, words = logs(a="fine"), tmp_path / "out", []
    assert call("fleet", folder, "-o", out, "--quiet").returncode == 0
    record = out / "results/a/run.json"
    if change == "recording":
        (folder / "a.clf").write_text("fine ")
    elif change == "options":
        words = ["--resolution", 0.1]
    elif change == "result":
        record.write_text(record.read_text().replace("80.0", "90.0"))
    elif change == "removed":
        record.unlink()
    else:
        (out / ".fleet/labels/results/a.json").write_text("{}")
    assert call("fleet", folder, "-o", out, "--quiet", *words).returncode == 0
    assert attempts(folder, "a") == 2
    assert "80.0" in record.read_text()
    assert unfinished(out) == set()


def test_same_content_elsewhere_is_not_mapped_again(call, logs, tmp_path):
    folder, out = logs(a="fine"), tmp_path / "out"
    assert call("fleet", folder, "-o", out, "--quiet").returncode == 0
    os.utime(folder / "a.clf", ns=(0, 0))
    assert call("fleet", folder, "-o", out, "--quiet").returncode == 0
    assert attempts(folder, "a") == 1


def test_bad_recording_is_named_and_the_rest_goes_on(call, logs, tmp_path):
    folder, out = logs(a="fine", b="bad", c="defect", d="fine"), tmp_path / "out"
    done = call("fleet", folder, folder / "missing.clf", "-o", out, "--quiet", "--json")
    assert done.returncode == 3
    found = listed(done)
    assert {name: one["status"] for name, one in found.items()} == {
        **dict.fromkeys("ad", "done"),
        **dict.fromkeys(("b", "c", "missing"), "failed"),
    }
    assert found["b"]["why"] == f"{folder / 'b.clf'}: no two scans"
    assert found["c"]["why"] == "a defect of stillmap: ValueError: 7"
    assert found["missing"]["why"] == f"{folder / 'missing.clf'}: does not exist"
    assert found["b"]["result"] is None
    assert sorted(done.stderr.splitlines()) == [
        f"stillmap: {name}: {found[name]['why']}" for name in ("b", "c", "missing")
    ]
    assert attempts(folder, "b") == 1  # it is not tried again
    page = (out / "fleet.html").read_text()
    assert "2 of 5 recordings mapped" in page
    assert "no two scans" in page
    assert unfinished(out) == set()


@pytest.mark.parametrize("times", [1, 3])
def test_killed_task_is_tried_again(call, logs, tmp_path, times):
    folder, out = logs(a=f"killed {times}", b="fine"), tmp_path / "out"
    assert call("fleet", folder, "-o", out, "--quiet").returncode == 0
    assert attempts(folder, "a") == times + 1
    assert unfinished(out) == set()


def test_four_times_killed_is_failed(call, logs, tmp_path):
    folder, out = logs(a="killed 9", b="fine"), tmp_path / "out"
    done = call("fleet", folder, "-o", out, "--quiet", "--json")
    assert done.returncode == 3
    assert attempts(folder, "a") == 4
    why = listed(done)["a"]["why"]
    assert why == "was ended by signal 9 in 4 attempts: is there enough memory?"
    assert unfinished(out) == set()


def test_full_disk_stops_the_fleet_with_one_line(call, logs, tmp_path):
    folder, out = logs(a="fine", b="full"), tmp_path / "out"
    done = call("fleet", folder, "-o", out, "--quiet", "--jobs", 1)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert "cannot continue: " in line
    assert "No space left on device (make room, then continue with the same command)" in line
    assert unfinished(out) == set()
    (folder / "b.clf").write_text("fine")
    assert call("fleet", folder, "-o", out, "--quiet").returncode == 0
    assert attempts(folder, "a") == 1


def test_disk_that_is_full_for_the_journal(call, logs, tmp_path, monkeypatch):
    folder, out = logs(a="fine", b="fine"), tmp_path / "out"
    append = storage.FolderStorage.append_line

    def refuse(self, name, line):
        if b'"mapping"' in line:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        append(self, name, line)

    with monkeypatch.context() as patched:
        patched.setattr(storage.FolderStorage, "append_line", refuse)
        done = call("fleet", folder, "-o", out, "--quiet", "--jobs", 1)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"stillmap: {out}: cannot continue: No space left on device")
    assert call("fleet", folder, "-o", out, "--quiet").returncode == 0
    assert attempts(folder, "a") == 1  # its label says that it is done


def manifest(tmp_path, text):
    path = tmp_path / "robots.csv"
    path.write_text(text)
    return path


def test_places_of_a_manifest_are_merged(call, logs, tmp_path):
    logs(a="fine", b="fine", c="fine", d="bad", e="fine", f="fine")
    rows = [f"logs/{name}.clf,{place}" for name, place in zip("abcdef", "xyxxyz", strict=True)]
    out = tmp_path / "out"
    path = manifest(tmp_path, "\n".join(["input,place", *rows]))
    done = call("fleet", "--manifest", path, "-o", out, "--quiet", "--json")
    assert done.returncode == 3  # because of d
    found = listed(done)
    assert [found[name]["place"] for name in "abcdef"] == list("xyxxyz")
    assert found["a"]["place_result"] == "places/x"
    assert found["f"]["place_result"] is None
    assert found["f"]["place_why"] == "merging takes two maps, this place has 1"
    merged = {
        name: json.loads((out / f"places/{name}/run.json").read_text())["merged"] for name in "xy"
    }
    assert merged == {"x": ["a", "c"], "y": ["b", "e"]}
    assert sorted(os.listdir(out / "places")) == ["x", "y"]
    sessions = json.loads((out / "places/x/sessions.json").read_text())
    assert [one["input"] for one in sessions] == [f"{out}/results/a", f"{out}/results/c"]
    page = (out / "fleet.html").read_text()
    assert 'href="places/x/report.html"' in page
    assert "this place has 1" in page
    assert unfinished(out) == set()


def test_place_is_merged_again_when_one_is_added(call, logs, tmp_path):
    folder, out = logs(a="fine", b="fine"), tmp_path / "out"
    words = ("fleet", folder, "-o", out, "--quiet", "--merge")
    assert call(*words).returncode == 0
    before = (out / "places/all/run.json").stat()
    assert call(*words).returncode == 0
    assert os.path.samestat(before, (out / "places/all/run.json").stat())
    logs(c="fine")
    assert call(*words).returncode == 0
    assert json.loads((out / "places/all/run.json").read_text())["merged"] == ["a", "b", "c"]
    assert [attempts(folder, name) for name in "abc"] == [1, 1, 1]


def test_place_that_cannot_be_merged(call, logs, tmp_path, monkeypatch):
    folder, out = logs(a="fine", b="fine"), tmp_path / "out"
    run_stillmap = phases.Merge.run.__globals__["run_stillmap"]

    def refuse(words, stop):
        if words[0] != "merge":
            return run_stillmap(words, stop)
        ended = run_stillmap(["info"], stop)
        return ended._replace(status=2, stderr="stillmap: fewer than two sessions fit\n")

    monkeypatch.setitem(phases.Merge.run.__globals__, "run_stillmap", refuse)
    done = call("fleet", folder, "-o", out, "--quiet", "--merge", "--json")
    assert done.returncode == 3
    assert done.stderr == "stillmap: place all: fewer than two sessions fit\n"
    found = listed(done)
    assert [one["status"] for one in found.values()] == ["done", "done"]
    assert found["a"]["place_why"] == "fewer than two sessions fit"
    assert "fewer than two sessions fit" in (out / "fleet.html").read_text()
    assert not (out / "places").exists()


def test_fewer_at_once_where_memory_is_short(call, logs, tmp_path, monkeypatch):
    folder, out = logs(a="fine", b="fine"), tmp_path / "out"
    monkeypatch.setattr(phases, "machine_memory", lambda: 300 << 20)
    done = call("fleet", folder, "-o", out, "--jobs", 2)
    assert done.returncode == 0
    lines = done.stderr.splitlines()
    assert "stillmap: 1 at once, each with at most 0.21 GB of memory, for a" in lines
    (warning,) = [line for line in lines if line.startswith("stillmap: warning")]
    assert "not 2 at once: they may need more than the 0.315 GB of this machine" in warning


def test_memory_that_is_given(call, logs, tmp_path):
    folder, out = logs(a="fine", b="fine"), tmp_path / "out"
    done = call("fleet", folder, "-o", out, "--jobs", 2, "--memory", 0.3)
    assert done.returncode == 0
    assert "not 2 at once: they may need more than the 0.3 GB that are given" in done.stderr
    assert call("fleet", folder, "-o", out, "--memory", -1).returncode == 2


def test_lines_without_a_terminal(call, logs, tmp_path):
    folder, out = logs(a="fine", b="bad"), tmp_path / "out"
    lines = call("fleet", folder, "-o", out, "--jobs", 1).stderr.splitlines()
    assert "stillmap: 2 recordings: 2 to map (0.02 h), 0 mapped already, 0 cannot be read" in lines
    assert [line for line in lines if "mapping" in line] == [
        "stillmap: mapping: 1 of 2, a",
        "stillmap: mapping: 2 of 2, b",
    ]
    assert f"stillmap: wrote {out}: open {out}/fleet.html" in lines


def test_foreign_folder_is_refused(call, logs, tmp_path):
    folder, out = logs(a="fine"), tmp_path / "out"
    out.mkdir()
    (out / "thesis.tex").write_text("dear")
    done = call("fleet", folder, "-o", out)
    assert done.returncode == 2
    assert f"{out}: already holds something" in done.stderr
    assert os.listdir(out) == ["thesis.tex"]


def test_two_fleets_in_one_folder(call, logs, tmp_path):
    folder, out = logs(a="fine"), tmp_path / "out"
    (out / ".fleet").mkdir(parents=True)
    (out / ".fleet/journal.jsonl").write_text('{"event": "started"}\n')
    with (out / ".fleet/lock").open("ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        done = call("fleet", folder, "-o", out)
    assert done.returncode == 2
    assert done.stderr == (
        f"stillmap: {out}: another fleet is writing there (wait for it, or stop it)\n"
    )
    assert attempts(folder, "a") == 0


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
        (["ftp://a/b"], "only paths and s3"),
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


def test_names_of_results_stay(call, logs, tmp_path):
    folder, out = logs(b="fine"), tmp_path / "out"
    other = tmp_path / "earlier"
    other.mkdir()
    (other / "b.clf").write_text("fine 2")
    assert call("fleet", folder, "-o", out, "--quiet").returncode == 0
    done = call("fleet", other, folder, "-o", out, "--quiet", "--json")
    found = {one["input"]: one["result"] for one in json.loads(done.stdout)}
    assert found == {str(other / "b.clf"): "results/b-2", str(folder / "b.clf"): "results/b"}
    assert attempts(folder, "b") == 1
