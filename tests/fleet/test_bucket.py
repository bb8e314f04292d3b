"""Recordings and results in buckets of a real S3 server."""

import json
import os
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from fleet_processes import NAMES
from result_contents import contents

from stillmap.core.errors import InputError
from stillmap.fleet.inputs import open_location

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
    done = call(
        "fleet", "s3://robots/day", "-o", "s3://robots/maps", "--json", "--quiet", "--jobs", 2
    )
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
        plain = {key for key in by_hand[name] if key not in ("run.json", "report.html")}
        assert {key: got[key] for key in plain} == {key: by_hand[name][key] for key in plain}
    assert json.loads(s3.cat("robots/maps/fleet.json")) == list(found.values())
    assert b"2 of 3 recordings mapped" in s3.cat("robots/maps/fleet.html")


def fill(s3, **contents):
    for name, text in contents.items():
        s3.pipe_file(f"robots/logs/{name}.clf", text.encode())


LOGS_TO_OUT = ("s3://robots/logs", "-o", "s3://robots/out", "--quiet")


def test_half_an_upload_is_no_result(stand_in, s3):
    fill(s3, a="fine")
    assert stand_in(*LOGS_TO_OUT).returncode == 0
    # as an upload leaves it that is interrupted
    s3.rm_file("robots/out/results/a/made.json")
    s3.pipe_file("robots/out/results/a/objects/9999.ply", b"stale")
    assert stand_in(*LOGS_TO_OUT).returncode == 0
    names = [one.removeprefix("out/results/a/") for one in listed(s3) if "results/a/" in one]
    assert names == ["beams/stamp_ns.npy", "made.json", "map.npz", "run.json"]


def test_bucket_to_folder(stand_in, s3, tmp_path):
    fill(s3, a="fine", b="fine")
    out = tmp_path / "out"
    done = stand_in("s3://robots/logs/*.clf", "-o", out, "--quiet", "--merge")
    assert done.returncode == 0, done.stderr
    sessions = json.loads((out / "places/all/sessions.json").read_text())
    assert [one["input"] for one in sessions] == [f"{out}/results/{name}" for name in "ab"]
    record = json.loads((out / "results/a/run.json").read_text())
    assert record["input"]["path"] == "s3://robots/logs/a.clf"
    assert sorted(os.listdir(out / "results")) == ["a", "b"]


def test_manifest_and_missing_object(stand_in, s3, tmp_path):
    fill(s3, a="fine")
    rows = ["input,place", "a.clf,", "s3://robots/logs/b.clf,"]
    s3.pipe_file("robots/logs/m.csv", "\n".join(rows).encode())
    done = stand_in("--manifest", "s3://robots/logs/m.csv", "-o", tmp_path / "out", "--quiet")
    assert done.returncode == 3
    assert done.stderr == "stillmap: b: s3://robots/logs/b.clf: does not exist\n"


def test_a_bucket_without_access(stand_in, s3, monkeypatch, tmp_path):
    class Forbidden(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_error(403)

        do_HEAD = do_PUT = do_POST = do_GET

        def log_message(self, *_):
            pass

    fill(s3, a="fine")
    log = tmp_path / "a.clf"
    log.write_text("fine")
    with ThreadingHTTPServer(("127.0.0.1", 0), Forbidden) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.server_port}")
        s3fs.S3FileSystem.clear_instance_cache()
        for words in (("s3://robots/logs", "-o", tmp_path / "out"), (log, "-o", "s3://robots/out")):
            done = stand_in(*words, "--quiet")
            assert done.returncode == 2
            (line,) = done.stderr.splitlines()
            assert "s3://robots/" in line
            assert "Forbidden" in line
        server.shutdown()
    s3fs.S3FileSystem.clear_instance_cache()


def test_missing_library():
    with pytest.raises(InputError, match=r"gs://robots/out: cannot be opened: .*gcsfs"):
        open_location("gs://robots/out")
