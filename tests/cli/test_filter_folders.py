"""`stillmap filter` of folders, into other formats, and what is refused."""

import numpy as np
import pytest
from flat import files_of
from labelled import N, check_same_but, kitti, label, run
from refusals import refused

from stillmap.io import read


@pytest.mark.parametrize(
    ("layout", "times"),
    [("velodyne", "times.txt"), ("velodyne_points/data", "velodyne_points/timestamps.txt")],
)
def test_kitti_folder(call, tmp_path, layout, times):
    """Rows go, bit for bit; the damaged scan becomes an empty file, so that numbers stay."""
    source = kitti(tmp_path / "drive", layout, times)
    recording, blank = label(source, tmp_path / "drive/out")
    summary = run(call, source / "out", tmp_path / "clean")
    assert summary["blanked"] == blank.sum() > 20
    assert summary["scans_left_out"] == 1
    before, after = files_of(source), files_of(tmp_path / "clean")
    assert set(after) == {name for name in before if not name.startswith("out/")}
    for scan, number in enumerate((0, 1, 3)):
        name = f"{layout}/{number:06d}.bin"
        rows = np.frombuffer(before.pop(name), "V16")
        assert after.pop(name) == rows[~blank[recording.beams_of(scan)]].tobytes()
    assert after.pop(f"{layout}/000002.bin") == b""
    labels = np.flatnonzero(~blank[recording.beams_of(1)]).astype("<u4")
    assert after.pop("labels/000001.label") == labels.tobytes()
    assert all(before[name] == data for name, data in after.items())
    assert check_same_but(recording, tmp_path / "clean", blank).n_scans == 3


@pytest.mark.parametrize("linked", ["labels", "labels/000001.label"])
def test_linked_labels_of_the_source_stay(call, tmp_path, linked):
    source = kitti(tmp_path / "drive")
    (tmp_path / "truth").mkdir()
    (source / linked).rename(tmp_path / "truth/given")
    (source / linked).symlink_to(tmp_path / "truth/given")
    recording, blank = label(source, tmp_path / "out")
    before = files_of(tmp_path / "truth")
    run(call, tmp_path / "out", tmp_path / "clean")
    assert files_of(tmp_path / "truth") == before
    after = (tmp_path / "clean/labels/000001.label").read_bytes()
    assert len(after) == 4 * (~blank[recording.beams_of(1)]).sum()
    assert (tmp_path / "clean/labels/000003.label").read_bytes() == b"of other points"


@pytest.mark.parametrize("output", ["clean.ply", "clean:pcd"])
def test_clouds_without_poses_get_those_of_the_map(call, tmp_path, output):
    source = kitti(tmp_path / "drive")
    (source / "poses.txt").unlink()
    recording, blank = label(source, tmp_path / "out")
    assert recording.T_recorded_base is None
    name, _, form = output.partition(":")
    done = call("filter", tmp_path / "out", "-o", tmp_path / name, "--to", form or "ply")
    assert done.returncode == 0, done.stderr
    assert "no poses" not in done.stderr
    again = read(tmp_path / name)
    kept = recording.hit & ~blank
    ahead = recording.scans_of(np.flatnonzero(kept)).astype(np.float32)
    if form:
        np.testing.assert_array_equal(again.points[again.hit], recording.points[kept])
        np.testing.assert_array_equal(again.T_recorded_base[:, 0, 3], [0.0, 1.0, 2.0])
    else:
        moved = recording.points[kept] + ahead[:, None] * np.float32([1.0, 0.0, 0.0])
        np.testing.assert_allclose(again.points[again.hit], moved, atol=1e-5)


@pytest.mark.parametrize(
    "output", ["clean.mcap", "clean.bag", "clean:pcd", "clean:stillmap", "clean.ply"]
)
def test_other_formats_by_name(call, tmp_path, output):
    source = kitti(tmp_path / "drive")
    recording, blank = label(source, tmp_path / "out")
    name, _, form = output.partition(":")
    out = tmp_path / name
    done = call("filter", tmp_path / "out", "-o", out, *(("--to", form) if form else ()))
    assert done.returncode == 0, done.stderr
    assert f"{blank.sum()} beams blanked" in done.stderr
    assert "1 scans left out that were not mapped" in done.stderr
    assert ("recorded poses are left out" in done.stderr) == output.endswith(("mcap", "bag"))
    again = read(out)
    hits = again.points[again.hit]
    kept = recording.points[recording.hit & ~blank]
    if output == "clean.ply":
        assert len(hits) == len(kept)  # as one cloud
    else:
        np.testing.assert_array_equal(hits, kept)
        np.testing.assert_array_equal(again.stamp_ns, recording.stamp_ns)


def test_refusals_come_before_anything_is_read(call, tmp_path):
    source = kitti(tmp_path / "drive")
    label(source, tmp_path / "out")
    (source / "times.txt").unlink()  # reading it would fail
    for output, words in (
        ("clean.log", ("clean.log", "2D at most", "3D")),
        ("clean.pcd", ("clean.pcd", "not written")),
        ("drive/clean", ("lies in the folder of the recording",)),
        (".", ("holds the recording",)),
    ):
        refused(call("filter", tmp_path / "out", "-o", tmp_path / output), *words)
    (tmp_path / "full").mkdir()
    (tmp_path / "full/other").write_text("")
    for more, words in (((), "already holds"), (("--overwrite",), "holds other things")):
        refused(call("filter", tmp_path / "out", "-o", tmp_path / "full", *more), words)
    (tmp_path / "out/beams/hit.npy").unlink()
    refused(call("filter", tmp_path / "out", "-o", tmp_path / "clean"), "hit.npy")
    assert sorted(one.name for one in tmp_path.iterdir()) == ["drive", "full", "out"]


def test_links_to_other_places_stay_links(call, tmp_path):
    """Linked folders of scans are written, others are not copied."""
    real = kitti(tmp_path / "real")
    (tmp_path / "drive").mkdir()
    for name in ("velodyne", "image_2"):
        (tmp_path / "drive" / name).symlink_to(f"../real/{name}")
    (tmp_path / "drive/times.txt").write_text((real / "times.txt").read_text())
    _, blank = label(tmp_path / "drive", tmp_path / "out")
    run(call, tmp_path / "out", tmp_path / "far/away/clean")
    clean = tmp_path / "far/away/clean"
    assert (clean / "image_2").resolve() == real / "image_2"
    assert not (clean / "velodyne").is_symlink()
    sizes = [path.stat().st_size for path in (clean / "velodyne").iterdir()]
    assert sum(sizes) == 16 * (3 * N - blank.sum())
    assert (real / "velodyne/000000.bin").stat().st_size == 16 * N


@pytest.mark.parametrize(
    "options", [{"start": 0.05, "end": 0.15}, {"min_range": 3.0, "max_range": 7.0, "spin": "none"}]
)
def test_options_of_reading_do_not_move_rows(call, tmp_path, options):
    """Sweeps outside a part of the recording become empty; beams at maximum range stay."""
    source = kitti(tmp_path / "drive")
    recording, blank = label(source, tmp_path / "out", options=options)
    summary = run(call, tmp_path / "out", tmp_path / "clean")
    used = [1] if "start" in options else [0, 1, 3]
    assert (summary["blanked"], summary["scans_left_out"]) == (blank.sum(), 4 - len(used))
    for k in range(4):
        rows = np.fromfile(source / f"velodyne/{k:06d}.bin", "u1")
        expected = b""
        if k in used:
            gone = blank[recording.beams_of(used.index(k))]
            expected = rows.reshape(-1, 16)[~gone].tobytes()
        assert (tmp_path / f"clean/velodyne/{k:06d}.bin").read_bytes() == expected
