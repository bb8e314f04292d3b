"""From inputs and manifests to recordings with names and places."""

import json

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFile

from stillmap.core.errors import InputError
from stillmap.fleet.inputs import (
    Entry,
    absolute,
    fetch,
    find_sources,
    name_sources,
    read_manifest,
    short_name,
)

FLASER = "FLASER 2 1.0 1.0 0 0 0 0 0 0 1.0 host 1.0\n"


@pytest.fixture
def logs(tmp_path):
    for name in ("b.log", "a.clf", "notes.txt", "sub/deep.log"):
        path = tmp_path / "logs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("no recording\n" if name == "notes.txt" else FLASER)
    return tmp_path / "logs"


def entries_of(inputs, place):
    return [Entry(absolute(text), place) for text in inputs]


def names(entries, known=None):
    return [one.name for one in name_sources(find_sources(entries), known or {})]


def test_folder_is_expanded_one_level(logs):
    (logs / "damaged.bag").write_text("no bag")  # is listed, and fails later, by name
    (logs / ".hidden.log").write_text(FLASER)
    assert names(entries_of([str(logs)], None)) == ["a", "b", "damaged"]


def test_folder_that_is_a_recording_is_one(recordings):
    assert names(entries_of([str(recordings / "hall")], None)) == ["hall"]
    assert names(entries_of([str(recordings)], None)) == ["hall", "office", "yard"]


def test_pattern(logs):
    assert names(entries_of([f"{logs}/*"], None)) == ["a", "b", "deep"]
    assert names(entries_of([f"{logs}/?.log"], None)) == ["b"]


def test_each_recording_once(logs):
    entries = entries_of([str(logs), str(logs / "a.clf"), f"{logs}/*.log"], None)
    assert names(entries) == ["a", "b"]


def test_names_are_unique_and_stay(tmp_path):
    paths = [str(tmp_path / folder / "drive.clf.gz") for folder in ("x", "y", "z")]
    assert names(entries_of(paths, None)) == ["drive", "drive-2", "drive-3"]
    known = {paths[1]: "drive", paths[2]: "drive-2"}
    assert names(entries_of(paths, None), known) == ["drive-3", "drive", "drive-2"]
    # what is not asked for now keeps its name, too
    assert names(entries_of(paths[:1], None), known) == ["drive-3"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("/data/intel.clf.gz", "intel"),
        ("s3://robots/day 1/run.2.db3/", "run.2"),
        ("/data/.bag", "bag"),
        ("/data/../..", "recording"),
        ("/data/größe.mcap", "größe"),
    ],
)
def test_short_name(text, expected):
    assert short_name(text) == expected


@pytest.mark.parametrize("text", ["nothing://a", "s3://a/b::simplecache"])
def test_unknown_urls_are_refused(text):
    with pytest.raises(InputError, match=r"is no path or URL|chained"):
        absolute(text)


@pytest.mark.parametrize("name", ["../up", "a/../../up", "/etc/x", "a\\b"])
def test_unsafe_keys_are_refused(name, tmp_path):
    fs = fsspec.filesystem("memory")
    fs.store.clear()
    fs.store[f"/bucket/{name}"] = MemoryFile(fs, f"/bucket/{name}", b"x")
    with pytest.raises(InputError, match=r"unsafe name|does not exist"):
        fetch("memory://bucket", tmp_path / "in")
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


def write(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_csv_manifest(tmp_path, logs):
    text = '\ufeffinput,place\nlogs/a.clf,hall\n"logs/b.log",\ns3://robots/x.bag,"yard"\n'
    found = read_manifest(str(write(tmp_path, "m.csv", text)))
    expected = [(str(logs / "a.clf"), "hall"), (str(logs / "b.log"), None)]
    assert [(one.input, one.place) for one in found[:2]] == expected
    assert (found[2].input, found[2].place) == ("s3://robots/x.bag", "yard")
    assert found[1].where == f"{tmp_path / 'm.csv'}: entry 2"


def test_json_manifest(tmp_path):
    rows = [{"input": "a.bag", "place": "hall"}, {"input": "/b.bag"}]
    found = read_manifest(str(write(tmp_path, "m.json", json.dumps(rows))))
    assert [one.input for one in found] == [str(tmp_path / "a.bag"), "/b.bag"]
    assert [one.place for one in found] == ["hall", None]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("m.csv", "input,plaec\na,b\n", "m.csv: entry 1: .*plaec.*the columns are"),
        ("m.csv", "place\na\n", "m.csv: entry 1: .*`input`"),
        ("m.csv", "input,place\n", "m.csv: names no recording"),
        ("m.csv", "input,place\na,b\n,c\n", "m.csv: entry 2: .*input"),
        ("m.csv", "input,place\na,b,c\n", "m.csv: entry 1: "),
        ("m.csv", "input,place\na,../up\n", "m.csv: entry 1: place '../up' is no name of a folder"),
        ("m.csv", "input,place\na, \n", "m.csv: entry 1: place ' '"),
        ("m.csv", 'input,place\n"a,b\n', "m.csv: is no list"),
        ("m.json", "{", "m.json: is no list"),
        ("m.json", "{}", "m.json: is no list"),
        ("m.json", '[{"input": "a"}, 3]', "m.json: entry 2: "),
        ("m.json", '[{"input": 3}]', "m.json: entry 1: .*input"),
        ("m.json", '[{"input": "a", "place": 3}]', "m.json: entry 1: .*place"),
        ("m.json", "[" * 100_000, "m.json: is no list"),
    ],
)
def test_bad_manifests(tmp_path, name, text, message):
    with pytest.raises(InputError, match=message):
        read_manifest(str(write(tmp_path, name, text)))


@pytest.mark.usefixtures("logs")
def test_two_places_for_one_recording(tmp_path):
    text = "input,place\nlogs/a.clf,hall\nlogs,yard\n"
    entries = read_manifest(str(write(tmp_path, "m.csv", text)))
    with pytest.raises(
        InputError, match=r"m.csv: entry 2: .*a.clf is in two places: hall and yard"
    ):
        find_sources(entries)
