"""Recordings and results in buckets of a real S3 server."""

import json
import os
import sys
import urllib.request

import pytest
from fleets import NAMES
from result_contents import contents

from stillmap.cli.main import main
from stillmap.core.errors import InputError
from stillmap.fleet.backends import open_storage
from stillmap.fleet.bucket import BucketStorage, explain

s3fs = pytest.importorskip("s3fs")
pytestmark = [
    pytest.mark.usefixtures("s3_environment"),
    # of botocore and aiohttp, at the end of their event loop
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]


@pytest.fixture
def s3(s3_server):
    """An empty bucket `robots`, and a client of its own for looking at it."""
    client = s3fs.S3FileSystem(
        key="robot", secret="secret", endpoint_url=s3_server, use_listings_cache=False
    )
    for bucket in client.ls(""):
        client.rm(bucket, recursive=True)
    client.mkdir("robots")
    return client


def downloaded(s3, name, folder):
    s3.get(f"robots/{name}", str(folder / name.rpartition("/")[2]), recursive=True)
    return contents(folder / name.rpartition("/")[2])


def listed(s3):
    return [one.removeprefix("robots/") for one in s3.find("robots")]


@pytest.mark.slow
def test_recordings_and_results_in_a_bucket(call, s3, recordings, by_hand, tmp_path):
    for name in NAMES[:2]:
        s3.put(str(recordings / name), f"robots/day/{name}", recursive=True)
    s3.pipe_file("robots/day/damaged.bag", b"no bag")
    done = call("fleet", "s3://robots/day", "-o", "s3://robots/maps", "--json", "--quiet")
    assert done.returncode == 3, done.stderr
    line, *others = done.stderr.splitlines()
    assert not others, done.stderr
    assert line.startswith("stillmap: damaged: s3://robots/day/damaged.bag: is no bag")
    found = {one["name"]: one for one in json.loads(done.stdout)}
    assert found["hall"]["input"] == "s3://robots/day/hall"
    for name in NAMES[:2]:
        got = downloaded(s3, f"maps/results/{name}", tmp_path)
        run = json.loads(got["run.json"])
        assert run["input"]["path"] == f"s3://robots/day/{name}"
        # the one difference: where the recording lies
        for file in ("run.json", "report.html"):
            here = str(recordings / name).encode()
            assert got[file] == by_hand[name][file].replace(
                here, f"s3://robots/day/{name}".encode()
            )
        plain = {key for key in got if key not in ("run.json", "report.html")}
        assert {key: got[key] for key in plain} == {key: by_hand[name][key] for key in plain}
    assert json.loads(s3.cat("robots/maps/fleet.json")) == list(found.values())
    assert b"2 of 3 recordings mapped" in s3.cat("robots/maps/fleet.html")
    assert os.listdir(tmp_path / "tmp") == []


@pytest.mark.usefixtures("stand_in")
class TestStandIn:
    """What does not depend on the maps themselves."""

    def fill(self, s3, **contents):
        for name, text in contents.items():
            s3.pipe_file(f"robots/logs/{name}.clf", text.encode())

    def test_goes_on(self, call, s3, tmp_path):
        self.fill(s3, a="fine", b="bad")
        words = ("fleet", "s3://robots/logs", "-o", "s3://robots/out", "--quiet")
        assert call(*words).returncode == 3
        before = s3.info("robots/out/results/a/run.json")
        self.fill(s3, b="fine", c="fine")
        assert call(*words).returncode == 0
        assert s3.info("robots/out/results/a/run.json") == before
        names = {one.split("/")[2] for one in listed(s3) if one.startswith("out/results")}
        assert names == set("abc")
        assert os.listdir(tmp_path / "tmp") == []

    def test_changed_object_is_mapped_again(self, call, s3):
        words = ("fleet", "s3://robots/logs", "-o", "s3://robots/out", "--quiet")
        for text in ("fine", "fine "):  # of another size, then of the same
            self.fill(s3, a=text)
            assert call(*words).returncode == 0
        before = s3.cat("robots/out/.fleet/labels/results/a.json")
        self.fill(s3, a="fine\n")
        assert call(*words).returncode == 0
        assert s3.cat("robots/out/.fleet/labels/results/a.json") != before

    def test_half_an_upload_is_no_result(self, call, s3):
        self.fill(s3, a="fine")
        words = ("fleet", "s3://robots/logs", "-o", "s3://robots/out", "--quiet")
        assert call(*words).returncode == 0
        # as an upload leaves it that is interrupted
        s3.rm_file("robots/out/results/a/run.json")
        s3.pipe_file("robots/out/results/a/objects/9999.ply", b"stale")
        s3.call_s3("create_multipart_upload", Bucket="robots", Key="out/results/a/static.ply")
        assert call(*words).returncode == 0
        found = [one for one in listed(s3) if one.startswith("out/results/a/")]
        assert found == ["out/results/a/map.npz", "out/results/a/run.json"]
        assert "Uploads" not in s3.call_s3("list_multipart_uploads", Bucket="robots")

    def test_places_are_merged(self, call, s3, tmp_path):
        self.fill(s3, a="fine", b="fine")
        done = call("fleet", "s3://robots/logs", "-o", "s3://robots/out", "--quiet", "--merge")
        assert done.returncode == 0, done.stderr
        sessions = json.loads(s3.cat("robots/out/places/all/sessions.json"))
        assert [one["input"] for one in sessions] == [
            "s3://robots/out/results/a",
            "s3://robots/out/results/b",
        ]
        assert os.listdir(tmp_path / "tmp") == []

    def test_bucket_to_folder(self, call, s3, tmp_path):
        self.fill(s3, a="fine", b="fine")
        out = tmp_path / "out"
        done = call("fleet", "s3://robots/logs/*.clf", "-o", out, "--quiet", "--merge")
        assert done.returncode == 0, done.stderr
        sessions = json.loads((out / "places/all/sessions.json").read_text())
        assert [one["input"] for one in sessions] == [f"{out}/results/{name}" for name in "ab"]
        assert sorted(os.listdir(tmp_path)) == ["out", "tmp"]
        assert os.listdir(tmp_path / "tmp") == []

    @pytest.mark.parametrize("failures", [1, 9])
    def test_a_bucket_that_fails_for_a_while(self, call, s3, monkeypatch, failures):
        self.fill(s3, a="fine")
        publish, left = BucketStorage.publish, [failures]

        def fail_first(storage, folder, name):
            left[0] -= 1
            with explain("s3://robots/out", "written"):
                if left[0] >= 0:
                    raise OSError("the connection was reset")
            publish(storage, folder, name)

        monkeypatch.setattr(BucketStorage, "publish", fail_first)
        done = call("fleet", "s3://robots/logs", "-o", "s3://robots/out", "--quiet")
        if failures == 1:
            assert (done.returncode, done.stderr) == (0, "")
            assert "out/results/a/run.json" in listed(s3)
        else:  # after four attempts
            what = "stillmap: a: s3://robots/out: cannot be written: the connection was reset\n"
            assert (done.returncode, done.stderr, left) == (3, what, [failures - 4])

    def test_manifest_and_missing_object(self, call, s3, tmp_path):
        self.fill(s3, a="fine")
        rows = ["input,place", "s3://robots/logs/a.clf,", "s3://robots/logs/b.clf,"]
        (tmp_path / "m.csv").write_text("\n".join(rows))
        done = call("fleet", "--manifest", tmp_path / "m.csv", "-o", tmp_path / "out", "--quiet")
        assert done.returncode == 3
        assert done.stderr == "stillmap: b: s3://robots/logs/b.clf: does not exist\n"

    def test_folder_with_other_things(self, call, s3):
        self.fill(s3, a="fine")
        done = call("fleet", "s3://robots/logs", "-o", "s3://robots/logs")
        assert done.returncode == 2
        assert "s3://robots/logs: already holds something" in done.stderr
        assert listed(s3) == ["logs/a.clf"]


def one_line(done):
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    return line


@pytest.mark.usefixtures("s3")
def test_bucket_that_is_not_there(call, recordings):
    line = one_line(call("fleet", recordings / "hall", "-o", "s3://nowhere/out"))
    assert line == "stillmap: s3://nowhere: there is no such bucket"
    line = one_line(call("fleet", "s3://nowhere/day", "-o", "s3://robots/out"))
    assert line == "stillmap: s3://nowhere: there is no such bucket"


@pytest.mark.usefixtures("s3")
def test_bucket_without_access(call, s3_server, recordings, tmp_path):
    with urllib.request.urlopen(_post(s3_server, b"0")):  # from now on keys are checked
        pass
    try:
        line = one_line(call("fleet", recordings / "hall", "-o", "s3://robots/out"))
        assert line.startswith("stillmap: s3://robots/out/.fleet/journal: cannot be read: ")
        line = one_line(call("fleet", "s3://robots/day", "-o", tmp_path / "out"))
        assert line.startswith("stillmap: s3://robots/day: cannot be read: ")
    finally:
        with urllib.request.urlopen(_post(s3_server, b"inf")):
            pass
    assert not (tmp_path / "out").exists()


def _post(server, data):
    headers = {"Content-Type": "text/plain"}
    return urllib.request.Request(f"{server}/moto-api/reset-auth", data=data, headers=headers)


def test_no_server_answers(recordings, monkeypatch, capsys):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setattr("stillmap.fleet.bucket._RETRIES", {"max_attempts": 1, "mode": "standard"})
    assert main(["fleet", str(recordings), "-o", "s3://robots/out"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "s3://robots/out/.fleet/journal: cannot be read: Could not connect" in line


def test_missing_library(monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(InputError, match=r"needs s3fs.*install.*\[s3\]"):
        open_storage("s3://robots/out")
