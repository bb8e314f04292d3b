"""Parts of every format, read as one recording: the same as the one that was cut."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cut_recordings import CASES, PERIOD, START, N, cut, make_recording, write_parts, write_whole
from recordings import require_same_arrays

from stillmap.core import arrays, se2
from stillmap.core.camera import Camera, Images
from stillmap.core.errors import InputError
from stillmap.core.source import SensorNotes, Source
from stillmap.io import read, writers
from stillmap.io.reader import join_recordings, read_parts
from stillmap.pipeline import inputs

SPANS = ((0.0, 1.9), (2.0, 3.4), (3.5, 5.9))


@pytest.mark.parametrize(("dimension", "form"), CASES)
def test_parts_in_any_order_are_the_whole(dimension, form, tmp_path):
    recording = make_recording(dimension)
    paths = write_parts(recording, tmp_path, form, *SPANS)
    whole = read(write_whole(recording, tmp_path, form))
    joined = inputs.read([paths[k] for k in (2, 0, 1)])
    require_same_arrays(joined, whole)
    noted = joined.source.parts
    assert [part.path for part in noted] == paths
    assert [part.scans for part in noted] == [20, 15, 25]
    assert noted[1].first_stamp_ns == START * 10**9 + 20 * int(1e9 * PERIOD)
    assert joined.source.path == paths[0]


def test_lines_that_the_first_part_of_a_log_alone_has(tmp_path, drive):
    writers.write(drive, tmp_path / "whole.log")
    lines = (tmp_path / "whole.log").read_text().splitlines(keepends=True)
    head = [line for line in lines if not line.startswith(("FLASER", "ODOM", "ROBOTLASER"))]
    rows = [line for line in lines if line not in head]
    params = ["PARAM robot_frontlaser_offset 0.25 nohost 0\n", "PARAM laser_front_laser_fov 90\n"]
    (tmp_path / "whole.log").write_text("".join([*params, *rows]))
    (tmp_path / "a.log").write_text("".join([*params, *rows[:31]]))
    (tmp_path / "b.log").write_text("\ufeff" + "".join(rows[31:]))
    paths = [str(tmp_path / name) for name in ("b.log", "a.log")]
    joined = inputs.read(paths)
    require_same_arrays(joined, read(tmp_path / "whole.log"))
    assert joined.source.details["lines"] == len(rows) + 2
    assert joined.T_base_sensor[0, 0, 2] == 0.25


def test_damage_in_a_later_part_is_counted_at_its_line(tmp_path, drive):
    paths = write_parts(drive, tmp_path, "carmen", (0.0, 2.9), (3.0, 5.9))
    first, second = (Path(path).read_text() for path in paths)
    before = len(first.splitlines())
    kind = second.splitlines()[-1].split()[0]
    Path(paths[1]).write_text(f"{kind} 3 1 2 broken\n{second}")
    [damage] = inputs.read(paths).source.skipped.values()
    assert damage.lines == [before + 1]


def test_an_unreadable_part_is_named(tmp_path, drive):
    paths = write_parts(drive, tmp_path, "carmen", (0.0, 5.9))
    with pytest.raises(InputError, match="does not exist") as caught:
        inputs.read([*paths, tmp_path / "gone.log"])
    assert caught.value.where == str(tmp_path / "gone.log")


def test_large_parts_are_joined_in_files(tmp_path, drive, monkeypatch):
    monkeypatch.setattr(arrays, "MAX_BYTES_IN_MEMORY", 1000)
    monkeypatch.setattr(arrays, "BLOCK", 100)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    paths = write_parts(drive, tmp_path, "stillmap", (0.0, 2.5), (2.6, 5.9))
    joined = read_parts(paths, scratch=scratch)
    assert isinstance(joined.points, np.ndarray)
    assert not joined.points.flags.owndata  # mapped
    require_same_arrays(joined, read(write_whole(drive, tmp_path, "stillmap")))
    assert list(scratch.iterdir()) == []


def pictures(stamps, value, name="front"):
    camera = Camera(name, 4, 3, np.eye(3), "", np.zeros(0), np.eye(4))
    stamp_ns = np.array(stamps, np.int64)

    def load(image):
        return np.full((3, 4), value + image, np.uint8)

    return Images(stamp_ns, np.zeros(len(stamps), np.int32), (camera,), load)


def test_recorded_poses_that_do_not_continue_are_left_out():
    whole = make_recording(3)
    first, second = cut(whole, 0.0, 2.9), cut(whole, 3.0, 5.9)
    posed = [replace(one, T_recorded_base=one.T_odom_base) for one in (first, second)]
    joined = join_recordings(posed, ["a", "b"], None)
    np.testing.assert_array_equal(joined.T_recorded_base, whole.T_odom_base)
    anew = replace(
        posed[1], T_recorded_base=se2.inverse(second.T_odom_base[0]) @ second.T_odom_base
    )
    joined = join_recordings([posed[0], anew], ["a", "b"], None)
    assert joined.T_recorded_base is None
    assert any("do not continue" in text for text in joined.source.warnings)


def test_a_raw_kitti_drive_in_pieces(tmp_path):
    whole = tmp_path / "whole"
    rng = np.random.default_rng(1)
    scans = [rng.uniform(-9.0, 9.0, (30, 4)).astype("<f4") for _ in range(20)]
    stamps = [f"2011-09-26 13:02:{25 + 0.1037 * k:012.9f}" for k in range(20)]
    spans = {whole: range(20), tmp_path / "a": range(9), tmp_path / "b": range(9, 20)}
    for folder, rows in spans.items():
        (folder / "velodyne_points/data").mkdir(parents=True)
        for number, k in enumerate(rows):
            scans[k].tofile(folder / f"velodyne_points/data/{number:010d}.bin")
        text = "".join(f"{stamps[k]}\n" for k in rows)
        (folder / "velodyne_points/timestamps.txt").write_text(text)
    joined = inputs.read([tmp_path / "b", tmp_path / "a"])
    require_same_arrays(joined, read(whole))
    assert joined.beam_time is not None


def test_images_of_parts():
    whole = make_recording(3)
    first = replace(cut(whole, 0.0, 2.9), images=pictures([10, 30], 0))
    second = replace(cut(whole, 3.0, 5.9), images=pictures([20, 40], 100))
    joined = join_recordings([first, second], ["a", "b"], None)
    assert joined.images.stamp_ns.tolist() == [10, 20, 30, 40]
    assert [joined.images.read(k)[0, 0] for k in range(4)] == [0, 100, 1, 101]
    assert len(joined.images.cameras) == len(joined.T_base_sensor) == 1


def test_interleaved_scans_are_put_in_order(drive):
    late = replace(cut(drive, 0.0, 0.3), stamp_ns=drive.stamp_ns[:4] + 50_000_000)
    joined = join_recordings([cut(drive, 0.0, 0.3), late], ["a", "b"], None)
    assert np.all(np.diff(joined.stamp_ns) > 0)
    np.testing.assert_array_equal(joined.points[: 2 * N], np.tile(drive.points[:N], (2, 1)))


def anew(recording):
    """The recording with odometry that begins at zero."""
    T = recording.T_odom_base
    return replace(recording, T_odom_base=se2.inverse(T[:1]) @ T)


def breaks(whole):
    """Recordings that do not go on where the first three seconds of a whole one end."""
    second = cut(whole, 3.0, 5.9)
    return {
        "it begins 864": make_recording(start=START + 86403),
        "it is of the same time": cut(whole, 2.0, 5.9),
        "it is 3D": cut(make_recording(3), 3.0, 5.9),
        "one of them has no odometry": second.without_odometry(),
        "its odometry begins anew": anew(second),
        "it has other sensors": replace(second, source=Source(sensors=[SensorNotes("/front")])),
    }


@pytest.mark.parametrize("why", breaks(make_recording()))
def test_what_does_not_follow_is_refused_and_merge_named(tmp_path, drive, why):
    first, second = tmp_path / "first", tmp_path / "second"
    writers.write(cut(drive, 0.0, 2.9), first)
    writers.write(breaks(drive)[why], second)
    with pytest.raises(InputError, match=f"does not follow {first}: {why}") as caught:
        inputs.read([second, first])
    assert f"stillmap merge {first} {second} -o DIR" in caught.value.hint
    assert caught.value.where == str(second)


@pytest.mark.parametrize("speed", [0.5, 20.0])
def test_a_pause_is_bridged(tmp_path, speed):
    whole = make_recording(speed=speed)
    paths = write_parts(whole, tmp_path, "stillmap", (0.0, 1.9), (2.9, 5.9))
    assert inputs.read(paths).n_scans == 20 + 31
    with pytest.raises(InputError, match="no recording is named"):
        inputs.read([])
