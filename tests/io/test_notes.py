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
