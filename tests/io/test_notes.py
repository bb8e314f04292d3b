"""Notes of readers in recording folders: those of ours stay, others do not get in the way."""

import json

import pytest

for needed in ("pye57", "laspy", "lazrs", "lzf"):
    pytest.importorskip(needed)
from faulty_inputs import RECORDINGS  # noqa: E402

from stillmap.core.json import to_json, to_jsonable  # noqa: E402
from stillmap.core.source import Source  # noqa: E402
from stillmap.io import read  # noqa: E402

FORMATS = {one.name.partition("-")[0]: one for one in RECORDINGS}
OTHERS = {"stillmap", "options.toml", "poses.tum", "cameras.toml"}


@pytest.mark.parametrize("reader", [FORMATS[name] for name in sorted(FORMATS.keys() - OTHERS)])
def test_notes_of_our_readers_stay(tmp_path, reader):
    (tmp_path / "in").mkdir()
    source = read(reader.make(tmp_path / "in")).source
    kept = json.loads(to_json(source.to_dict()))
    assert to_jsonable(Source.from_dict(kept).to_dict()) == kept != {}


@pytest.mark.parametrize("source", [None, [], 3, "x", {"sensors": 1, "warnings": [1], "path": {}}])
def test_notes_of_others(source):
    assert Source.from_dict(source) == Source()


@pytest.mark.parametrize(
    ("key", "value"),
    [("beams_per_scan", -(10**40)), ("start_angle", 1e308), ("places", -1), ("scans", 10**400)],
)
def test_numbers_that_cannot_be(key, value):
    assert Source.from_dict({"path": "a", "sensors": [{key: value}]}) == Source("a")
    assert Source.from_dict({"path": "a", "sensors": [{"grid": [-1, -1]}]}) == Source("a")
