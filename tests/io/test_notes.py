"""Notes of readers in recording folders: those of ours stay, others do not get in the way."""

import json
import sys
from pathlib import Path

import pytest

for needed in ("pye57", "laspy", "lazrs", "lzf"):
    pytest.importorskip(needed)
sys.path.append(str(Path(__file__).resolve().parent.parent / "faults"))

from faulty_inputs import RECORDINGS  # noqa: E402

from stillmap.core.json import to_jsonable  # noqa: E402
from stillmap.io import read  # noqa: E402
from stillmap.io.notes import prune_notes  # noqa: E402

FORMATS = {one.name.partition("-")[0]: one for one in RECORDINGS}
OTHERS = {"stillmap", "options.toml", "poses.tum", "cameras.toml"}


@pytest.mark.parametrize("reader", [FORMATS[name] for name in sorted(FORMATS.keys() - OTHERS)])
def test_notes_of_our_readers_stay(tmp_path, reader):
    (tmp_path / "in").mkdir()
    source = to_jsonable(read(reader.make(tmp_path / "in")).source)
    assert source
    assert prune_notes(json.loads(json.dumps(source))) == source


@pytest.mark.parametrize("source", [None, [], 3, "x", {"sensors": 1, "warnings": [1], "path": {}}])
def test_notes_of_others(source):
    assert prune_notes(source) == {}


def test_damaged_entries_go_alone():
    skipped = {"damaged": {"count": 1, "lines": [3]}}
    sensor = {"name": "laser", "scans": 2}
    box = {"sensor": 0, "beams": 2, "low": [0, 0, 1.5], "high": [1, 1, 2]}
    source = {
        "skipped": {**skipped, "late": {"count": -1, "lines": []}, "early": {"count": 1}},
        "sensors": [{**sensor, "frame": 3, "extrinsics": {"x": 1e400, "how": "default"}}],
        "self_filter": [box, {**box, "low": [0, 1]}],
        "part": {"scans": 2**70, "omitted": True, "path": "x"},
        "unknown": 1,
    }
    assert prune_notes(source) == {
        "skipped": skipped,
        "sensors": [{**sensor, "extrinsics": {"how": "default"}}],
        "part": {"path": "x"},
        "unknown": 1,
    }
