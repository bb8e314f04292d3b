"""The folder of a fleet, its journal, scratch folders, and hashes of recordings."""

import errno
import json
import os
import signal
import subprocess
import sys

import pytest

from stillmap.fleet.artifacts import find_result, key_of, write_label
from stillmap.fleet.content import fingerprint, hash_content
from stillmap.fleet.journal import Journal
from stillmap.fleet.scratch import remove_stale, scratch_folder
from stillmap.fleet.settings import Settings
from stillmap.fleet.storage import FolderStorage


@pytest.fixture
def storage(tmp_path):
    return FolderStorage(str(tmp_path / "fleet"))


def test_journal_is_read_again(storage):
    journal = Journal(storage)
    journal.note("named", input="/größe", name="a")
    journal.note("done", name="a")
    again = Journal(storage)
    assert again.find("named") == [{"event": "named", "input": "/größe", "name": "a"}]
    assert [one["event"] for one in again.find("done")] == ["done"]


@pytest.mark.parametrize("cut", range(1, 30, 4))
def test_torn_last_line_is_passed_over(storage, tmp_path, cut):
    journal = Journal(storage)
    for name in ("a", "b"):
        journal.note("done", name=name)
    path = tmp_path / "fleet" / ".fleet" / "journal.jsonl"
    path.write_bytes(path.read_bytes()[:-cut])
    after = Journal(storage)
    after.note("done", name="c")
    names = [one["name"] for one in Journal(storage).find("done")]
    # without its line feed alone a line is whole
    assert names == (["a", "b", "c"] if cut == 1 else ["a", "c"])


@pytest.mark.parametrize("line", [b"\xff\xfe", b"[]", b"3", b'{"event": 3}', b"[" * 100_000])
def test_damaged_line_is_passed_over(storage, line):
    journal = Journal(storage)
    storage.append_line(".fleet/journal", line)
    journal.note("done", name="a")
    assert len(Journal(storage).find("done")) == 1


def make_result(storage, text):
    with storage.attempt() as work:
        folder = work / "result"
        (folder / "beams").mkdir(parents=True)
        (folder / "run.json").write_text(text)
        (folder / "beams" / "hit.npy").write_bytes(b"x")
        storage.publish(folder, "results/a")


def test_published_result_replaces_the_one_before(storage, tmp_path):
    for text in ("one", "two"):
        make_result(storage, text)
    found = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert found == {"fleet/results/a/run.json", "fleet/results/a/beams/hit.npy"}
    assert storage.read("results/a/run.json") == b"two"


def test_result_fits_its_label(storage):
    make_result(storage, "one")
    write_label(storage, "results/a", "key", b"one", {"summary": {"map": None}})
    assert find_result(storage, "results/a", "key")["summary"] == {"map": None}
    assert find_result(storage, "results/a", "another key") is None
    make_result(storage, "two")  # replaced by something else
    assert find_result(storage, "results/a", "key") is None


@pytest.mark.parametrize("text", ["", "{}", "3", '{"label": [], "checksum": ""}', "[" * 100_000])
def test_damaged_label_is_none(storage, text):
    make_result(storage, "one")
    storage.write(".fleet/labels/results/a.json", text.encode())
    assert find_result(storage, "results/a", "key") is None


def test_changed_label_is_none(storage):
    make_result(storage, "one")
    write_label(storage, "results/a", "key", b"one", {"cpu_seconds": 3.0})
    changed = json.loads(storage.read(".fleet/labels/results/a.json"))
    changed["label"]["cpu_seconds"] = "much"
    storage.write(".fleet/labels/results/a.json", json.dumps(changed).encode())
    assert find_result(storage, "results/a", "key") is None


def test_write_leaves_the_old_file_when_the_disk_is_full(storage, tmp_path, monkeypatch):
    storage.write("fleet.json", b"old")

    def refuse(_handle):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(OSError, match="No space"):
        storage.write("fleet.json", b"new")
    assert storage.read("fleet.json") == b"old"
    found = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert found == {"fleet/fleet.json"}


HOLD = """
import sys, time
from pathlib import Path
from stillmap.fleet.scratch import scratch_folder
with scratch_folder(Path(sys.argv[1])) as path:
    (path / "half").write_text("half a result")
    print(path, flush=True)
    time.sleep(60)
"""


def test_scratch_of_a_killed_process_is_removed(tmp_path):
    words = [sys.executable, "-c", HOLD, str(tmp_path / "work")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        path = process.stdout.readline().strip()
        with scratch_folder(tmp_path / "work") as mine:
            remove_stale(tmp_path / "work")
            assert os.path.isdir(path)  # both processes live
            process.send_signal(signal.SIGKILL)
            process.wait()
            remove_stale(tmp_path / "work")
            assert not os.path.exists(path)
            assert mine.is_dir()
    assert not (tmp_path / "work").exists()


SHARE = """
import os, sys
from stillmap.fleet.bucket import local_scratch
for _ in range(400):
    with local_scratch() as path:
        (path / "file").write_text("mine")
"""


def test_fleets_of_one_user_share_the_folder_of_scratch_folders(tmp_path):
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    words = [sys.executable, "-c", SHARE]
    fleets = [
        subprocess.Popen(words, env=environment, stderr=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    ended = [(fleet.communicate()[1], fleet.returncode) for fleet in fleets]
    assert ended == [("", 0)] * 3
    assert list(tmp_path.iterdir()) == []


def test_content_decides_on_keys(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    for folder in (one, two):
        (folder / "sub").mkdir(parents=True)
        (folder / "sub" / "a.npy").write_bytes(b"abc")
    assert hash_content(one) == hash_content(two)
    assert hash_content(one).size == 3
    (two / "sub" / "a.npy").write_bytes(b"abd")
    assert hash_content(one).digest != hash_content(two).digest
    (two / "sub" / "a.npy").rename(two / "sub" / "b.npy")
    (two / "sub" / "b.npy").write_bytes(b"abc")
    assert hash_content(one).digest != hash_content(two).digest


def test_fingerprint_sees_a_change(tmp_path):
    path = tmp_path / "a.log"
    path.write_text("abc")
    before = fingerprint(str(path))
    assert fingerprint(str(path)) == before
    os.utime(path, ns=(0, path.stat().st_mtime_ns + 1))
    assert fingerprint(str(path)) != before


def test_threads_do_not_change_the_key():
    one = Settings((("em.prior", "0.8"),))
    two = Settings((("em.prior", "0.8"), ("threads", "2")))
    assert key_of("map", ["x"], one) == key_of("map", ["x"], two)
    others = [Settings(), Settings((("em.prior", "0.7"),)), Settings(one.options, False)]
    assert len({key_of("map", ["x"], other) for other in (one, *others)}) == 4
    assert key_of("map", ["x"], one) != key_of("map", ["y"], one)
