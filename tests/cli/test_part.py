"""`--from`, `--to`: a part of a recording, which its result remembers."""

import json
import re

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
    assert re.search(rf"omitted\s+{part['omitted']}\b", shown)
    done = call("convert", room, "-o", tmp_path / "a.clf", "--from", "1", "--until", "2")
    assert done.returncode == 0, done.stderr
    assert read(tmp_path / "a.clf").n_scans == 40 - part["omitted"]


def test_limits_that_cannot_be(call, room, tmp_path):
    for words in (("--from", "500"), ("--from", "2", "--to", "1")):
        done = call("map", room, "-o", tmp_path / "out", *words)
        refused(done, str(room), "has no scan", "the recording spans 0 to")
    for words in (("--from", "nan"), ("--to", "-3")):
        refused(call("map", room, "-o", tmp_path / "out", *words), "must be")
    with pytest.raises(SystemExit, match="2"):
        call("map", room, "-o", tmp_path / "out", "--from", "noon")
    assert not (tmp_path / "out").exists()


REGION = (-2.0, -2.0, 3.0, 2.5)  # a corner of the room


def cells_of(folder):
    with np.load(folder / "map.npz") as archive:
        found = {name: archive[name] for name in archive}
    x, y, _ = found["origin"]
    row, column = np.indices(found["p_occupied"].shape)
    size = float(found["resolution"])
    return found, np.stack([x + size * (column + 0.5), y + size * (row + 0.5)], axis=-1)


def in_region(xy):
    x0, y0, x1, y1 = REGION
    return (xy[..., 0] >= x0) & (xy[..., 0] <= x1) & (xy[..., 1] >= y0) & (xy[..., 1] <= y1)


def test_a_region_limits_the_map_and_neither_poses_nor_labels(call, room, tmp_path):
    whole, part = tmp_path / "whole", tmp_path / "part"
    assert call("map", room, "-o", whole, *QUICK).returncode == 0
    assert call("map", room, "-o", part, "--region", *REGION, *QUICK).returncode == 0
    for name in ("trajectory.tum", "beams/p_static.npy", "beams/hit.npy"):
        assert (whole / name).read_bytes() == (part / name).read_bytes()
    (a, at_a), (b, at_b) = cells_of(whole), cells_of(part)
    assert in_region(at_b).all()
    shown = in_region(at_a)
    assert shown.sum() == in_region(at_b).sum() < shown.size
    for name in ("p_occupied", "alpha", "beta", "looks", "clear_looks", "thin", "changed"):
        np.testing.assert_array_equal(b[name].ravel(), a[name][shown])
    tracks = json.loads((part / "objects/objects.json").read_text())
    assert all(
        in_region(np.stack([one["track"]["x"], one["track"]["y"]], axis=-1)).any() for one in tracks
    )
    assert len(tracks) <= len(json.loads((whole / "objects/objects.json").read_text()))
    record = json.loads((part / "run.json").read_text())
    assert record["options"]["output"]["region"] == list(REGION)
    assert call("filter", part, "-o", tmp_path / "clean", "--quiet").returncode == 0
    walls = [json.loads(call("eval", "map", out, room, "--json").stdout) for out in (whole, part)]
    assert walls[1]["reference_wall_cells"] < 0.8 * walls[0]["reference_wall_cells"]
    assert walls[1]["walls_kept"] > 0.9  # those outside are not missed
