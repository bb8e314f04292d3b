"""`--from`, `--to`: a part of a recording, which its result remembers."""

import json

import numpy as np
import pytest
from refusals import refused

from stillmap.io import read

QUICK = ("--set", "em.max_iterations=1", "--quiet")


@pytest.mark.parametrize("ending", ["", ".clf", ".bag"])
def test_a_part_is_mapped_and_filtered(call, room, tmp_path, ending):
    source = room
    if ending:
        source = tmp_path / f"room{ending}"
        assert call("convert", room, "-o", source, "--quiet").returncode == 0
    whole = read(source)
    seconds = (whole.stamp_ns - whole.stamp_ns[0]) / 1e9
    start, end = seconds[10], seconds[29]
    out = tmp_path / "out"
    done = call("map", source, "-o", out, "--from", start, "--to", end, *QUICK)
    assert done.returncode == 0, done.stderr
    stamps = np.load(out / "beams/stamp_ns.npy")
    np.testing.assert_array_equal(stamps, whole.stamp_ns[10:30])
    read_as = json.loads((out / "run.json").read_text())["options"]["read"]
    assert (read_as["start"], read_as["end"]) == (start, end)
    clean = tmp_path / f"clean{ending}"
    done = call("filter", out, "-o", clean)
    assert done.returncode == 0, done.stderr
    assert ("20 scans left out that were not mapped" in done.stderr) == bool(ending)
    np.testing.assert_array_equal(read(clean).stamp_ns, stamps)
    assert call("convert", out, "-o", tmp_path / "out.mcap", "--quiet").returncode == 0


def test_info_and_convert_take_a_part(call, room, tmp_path):
    done = call("info", room, "--from", "1", "--until", "2", "--json")
    part = json.loads(done.stdout)["part"]
    assert (part["start"], part["end"]) == (1.0, 2.0)
    shown = call("info", room, "--from", "1", "--to", "2").stdout
    assert f"{part['omitted']} scans left out" in shown
    done = call("convert", room, "-o", tmp_path / "a.clf", "--from", "1", "--until", "2")
    assert done.returncode == 0, done.stderr
    assert read(tmp_path / "a.clf").n_scans == 40 - part["omitted"]


def test_limits_that_cannot_be(call, room, tmp_path):
    for words in (("--from", "500"), ("--from", "2", "--to", "1")):
        done = call("map", room, "-o", tmp_path / "out", *words)
        refused(done, str(room), "has no scan", "the recording spans 0 to")
    for words in (("--from", "nan"), ("--to", "-3"), ("--from", "noon")):
        with pytest.raises(SystemExit, match="2"):
            call("map", room, "-o", tmp_path / "out", *words)
    assert not (tmp_path / "out").exists()
