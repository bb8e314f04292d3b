"""Results with given labels, as `stillmap map` would write them, and checks of filtered copies."""

import json
from pathlib import Path

import numpy as np

from stillmap.core.recording import Recording
from stillmap.io import read
from stillmap.io.trajectory import write_tum
from stillmap.results.writer import write_labels

N = 40  # points of a scan
RNG = np.random.default_rng(2)


def label(
    source: Path, folder: Path, share: float = 0.3, options: dict[str, object] | None = None
) -> tuple[Recording, np.ndarray]:
    """Write a result of a recording in which a share of the hits is dynamic, by chance.

    Returns:
        The recording, and (M,) whether beams are dynamic.
    """
    from stillmap.prepare.options import ReadOptions

    recording = read(source, ReadOptions(**(options or {})))
    rng = np.random.default_rng(5)
    blank = recording.hit & (rng.random(recording.n_beams) < share)
    p_static = np.where(blank, 0.1, 0.9).astype(np.float32)
    usable = ~np.isnan(recording.points).any(axis=1)
    folder.mkdir(parents=True)
    p_static[~usable] = np.nan
    write_labels(folder / "beams", recording, p_static)
    poses = np.tile(np.eye(recording.dimension + 1), (recording.n_scans, 1, 1))
    poses[:, 0, -1] = np.arange(recording.n_scans)  # a metre ahead at each scan
    write_tum(folder / "trajectory.tum", recording.stamp_ns, poses)
    if recording.dimension == 3:
        (folder / "static.ply").write_text("")
    record = {
        "format_version": 1,
        "input": {"path": str(source)},
        "options": {"read": options or {}},
    }
    (folder / "run.json").write_text(json.dumps(record))
    return recording, blank


def cloud(n=N):
    """(n, 4) float32 points and intensity with some that no beam can use."""
    rows = RNG.uniform(-8.0, 8.0, (n, 4)).astype(np.float32)
    rows[3, :3], rows[7, 0], rows[n - 1, :3] = 0.0, np.nan, np.inf
    return rows


def run(call, result, out, *more):
    done = call("filter", result, "-o", out, "--json", "--quiet", *more)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    return json.loads(done.stdout)


def check_same_but(before, after, blank):
    """The hits that were not blanked are there, in order, with their stamps and poses."""
    again, kept = read(after), before.hit & ~blank
    np.testing.assert_array_equal(again.points[again.hit], before.points[kept])
    np.testing.assert_array_equal(again.stamp_ns, before.stamp_ns)
    for name in ("T_recorded_base", "T_odom_base"):
        np.testing.assert_array_equal(getattr(again, name), getattr(before, name))
    if before.beam_time is not None:
        np.testing.assert_array_equal(again.beam_time[again.hit], before.beam_time[kept])
    return again


def kitti(folder, layout="velodyne", times="times.txt"):
    (folder / layout).mkdir(parents=True)
    for k in range(4):
        cloud().tofile(folder / layout / f"{k:06d}.bin")
    (folder / layout / "000002.bin").write_bytes(b"123")
    (folder / times).write_text("".join(f"{0.1 * k}\n" for k in range(4)))
    (folder / "image_2").mkdir()
    (folder / "image_2/000000.txt").write_text("no picture")
    (folder / "labels").mkdir()
    np.arange(N, dtype="<u4").tofile(folder / "labels/000001.label")
    (folder / "labels/000003.label").write_bytes(b"of other points")
    (folder / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    identity = "1 0 0 {} 0 1 0 0 0 0 1 0\n"
    (folder / "poses.txt").write_text("".join(identity.format(k) for k in range(4)))
    return folder
