"""Parts of every format, read as one recording: the same as the one that was cut."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cut_recordings import PERIOD, START, N, cut, make_recording, write_parts

from stillmap.core import arrays, se2
from stillmap.core.camera import Camera, Images
from stillmap.core.errors import InputError
from stillmap.io import read, writers
from stillmap.io.input_groups import group_inputs, read_parts
from stillmap.io.parts.joining import join_recordings
from stillmap.pipeline import inputs
from stillmap.prepare.options import ReadOptions

FORMS = {
    2: {
        "carmen": ".clf",
        "bag": ".bag",
        "db3": ".db3",
        "mcap": ".mcap",
        "ros2": "",
        "stillmap": "",
    },
    3: {"bag": ".bag", "mcap": ".mcap", "kitti": "", "pcd": "", "stillmap": ""},
}
CASES = [(dimension, form) for dimension, forms in FORMS.items() for form in forms]
SPANS = ((0.0, 1.9), (2.0, 3.4), (3.5, 5.9))
FIELDS = (
    *("stamp_ns", "offset", "points", "hit", "T_base_sensor", "sensor"),
    *("T_odom_base", "T_recorded_base", "beam_time"),
)


def require_equal(a, b):
    for name in FIELDS:
        one, other = getattr(a, name), getattr(b, name)
        assert (one is None) == (other is None), name
        if one is not None:
            np.testing.assert_array_equal(one, other, err_msg=name)


def write_whole(recording, folder, form, ending):
    writers.write(recording, folder / f"whole{ending}", name=form)
    return folder / f"whole{ending}"


@pytest.mark.parametrize(("dimension", "form"), CASES)
def test_parts_in_any_order_are_the_whole(dimension, form, tmp_path):
    ending, recording = FORMS[dimension][form], make_recording(dimension)
    paths = write_parts(recording, tmp_path, form, ending, *SPANS)
    whole = read(write_whole(recording, tmp_path, form, ending))
    shuffled = [paths[k] for k in (2, 0, 1)]
    [group] = group_inputs(shuffled)
    assert (list(group.paths), group.kind) == (paths, "parts")
    joined = inputs.read(shuffled)
    require_equal(joined, whole)
    noted = joined.source["parts"]
    assert [part["path"] for part in noted] == paths
    assert [part["scans"] for part in noted] == [20, 15, 25]
    assert noted[1]["first_stamp_ns"] == START * 10**9 + 20 * int(1e9 * PERIOD)
    assert joined.source["path"] == paths[0]


@pytest.mark.parametrize(("dimension", "form"), CASES)
def test_what_parts_repeat_is_read_once(dimension, form, tmp_path):
    ending, recording = FORMS[dimension][form], make_recording(dimension)
    paths = write_parts(recording, tmp_path, form, ending, (0.0, 2.5), (1.5, 4.5), (4.0, 5.9))
    joined = inputs.read(paths[::-1])
    require_equal(joined, read(write_whole(recording, tmp_path, form, ending)))
    assert any("hold already" in text for text in joined.source["duplicates"])
    assert not joined.source.get("skipped")


@pytest.mark.slow
@pytest.mark.parametrize(("dimension", "form"), CASES)
def test_the_time_window_counts_from_the_first_part(dimension, form, tmp_path):
    ending, recording = FORMS[dimension][form], make_recording(dimension)
    paths = write_parts(recording, tmp_path, form, ending, *SPANS)
    options = ReadOptions(start=1.0, end=3.0)
    joined = inputs.read(paths[::-1], options)
    require_equal(joined, read(write_whole(recording, tmp_path, form, ending), options))
    assert joined.n_scans == 21
    with pytest.raises(InputError, match=r"has no scan from 50 s .*spans 0 to 5\.90 s"):
        inputs.read(paths, ReadOptions(start=50.0))


def test_parts_of_different_formats(tmp_path, drive):
    first = write_parts(cut(drive, 0.0, 1.9), tmp_path, "carmen", ".log", (0.0, 9.0))
    second = str(tmp_path / "second.mcap")
    named = {"sensors": [{"name": "FLASER"}]}
    writers.write(replace(cut(drive, 2.0, 5.9), source=named), Path(second))
    groups = group_inputs([*first, second])
    assert len(groups) == 2  # FLASER is no topic
    joined = read_parts([*first, second])
    np.testing.assert_array_equal(joined.stamp_ns, drive.stamp_ns)
    assert joined.n_beams == drive.n_beams
    assert joined.source["format"] == "carmen, MCAP"


def test_lines_that_the_first_part_of_a_log_alone_has(tmp_path, drive):
    write_whole(drive, tmp_path, "carmen", ".log")
    lines = (tmp_path / "whole.log").read_text().splitlines(keepends=True)
    head = [line for line in lines if not line.startswith(("FLASER", "ODOM", "ROBOTLASER"))]
    rows = [line for line in lines if line not in head]
    params = ["PARAM robot_frontlaser_offset 0.25 nohost 0\n", "PARAM laser_front_laser_fov 90\n"]
    (tmp_path / "whole.log").write_text("".join([*params, *rows]))
    (tmp_path / "a.log").write_text("".join([*params, *rows[:31]]))
    (tmp_path / "b.log").write_text("\ufeff" + "".join(rows[31:]))
    paths = [str(tmp_path / name) for name in ("b.log", "a.log")]
    joined = inputs.read(paths)
    require_equal(joined, read(tmp_path / "whole.log"))
    assert joined.source["lines"] == len(rows) + 2
    assert joined.T_base_sensor[0, 0, 2] == 0.25


def test_damage_in_a_later_part_is_counted_at_its_line(tmp_path, drive):
    paths = write_parts(drive, tmp_path, "carmen", ".log", (0.0, 2.9), (3.0, 5.9))
    first, second = (Path(path).read_text() for path in paths)
    before = len(first.splitlines())
    kind = second.splitlines()[-1].split()[0]
    Path(paths[1]).write_text(f"{kind} 3 1 2 broken\n{second}")
    [damage] = inputs.read(paths).source["skipped"].values()
    assert damage["lines"] == [before + 1]


def test_sessions_are_refused_with_the_reason(tmp_path, drive):
    paths = write_parts(drive, tmp_path, "carmen", ".log", (0.0, 5.9))
    writers.write(make_recording(start=START + 86400), tmp_path / "next.log")
    with pytest.raises(
        InputError, match=r"no part of the same run.*begins 24\.0 h after"
    ) as caught:
        inputs.read([paths[0], tmp_path / "next.log"])
    assert caught.value.where == str(tmp_path / "next.log")
    with pytest.raises(InputError, match="no recording is named"):
        inputs.read([])


def test_an_unreadable_part_is_named(tmp_path, drive):
    paths = write_parts(drive, tmp_path, "carmen", ".log", (0.0, 5.9))
    with pytest.raises(InputError, match="does not exist") as caught:
        inputs.read([*paths, tmp_path / "gone.log"])
    assert caught.value.where == str(tmp_path / "gone.log")


def test_large_parts_are_joined_in_files(tmp_path, drive, monkeypatch):
    monkeypatch.setattr(arrays, "MAX_BYTES_IN_MEMORY", 1000)
    monkeypatch.setattr(arrays, "BLOCK", 100)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    paths = write_parts(drive, tmp_path, "stillmap", "", (0.0, 2.5), (1.5, 5.9))
    joined = read_parts(paths, scratch=scratch)
    assert isinstance(joined.points, np.ndarray)
    assert not joined.points.flags.owndata  # mapped
    require_equal(joined, read(write_whole(drive, tmp_path, "stillmap", "")))
    assert list(scratch.iterdir()) == []


def pictures(stamps, value, name="front"):
    camera = Camera(name, 4, 3, np.eye(3), "", np.zeros(0), np.eye(4))
    stamp_ns = np.array(stamps, np.int64)

    def load(image):
        return np.full((3, 4), value + image, np.uint8)

    return Images(stamp_ns, np.zeros(len(stamps), np.int32), (camera,), load)


def test_images_and_sensors_of_parts():
    whole = make_recording(3)
    first = replace(cut(whole, 0.0, 2.9), images=pictures([10, 30], 0))
    second = replace(cut(whole, 3.0, 5.9), images=pictures([20, 30, 40], 100))
    joined = join_recordings([first, second], ["a", "b"], None)
    assert joined.images.stamp_ns.tolist() == [10, 20, 30, 40]
    assert [joined.images.read(k)[0, 0] for k in range(4)] == [0, 100, 1, 102]
    assert len(joined.images.cameras) == 1
    assert len(joined.T_base_sensor) == 1
    other = replace(second, images=pictures([20], 7, "rear"))
    joined = join_recordings([first, other], ["a", "b"], None)
    assert [camera.name for camera in joined.images.cameras] == ["front", "rear"]
    assert joined.images.camera.tolist() == [0, 1, 0]


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
    assert any("do not continue" in text for text in joined.source["warnings"])
    joined = join_recordings([posed[0], second.without_odometry()], ["a", "b"], None)
    assert joined.T_odom_base is None
    assert len(joined.source["warnings"]) == 2


def test_parts_that_do_not_fit_are_refused():
    flat, space = make_recording(2), make_recording(3, start=START + 6)
    with pytest.raises(InputError, match="is 3D, the parts before it are 2D"):
        join_recordings([flat, space], ["a", "b"], None)
    first, second = cut(make_recording(3), 0.0, 2.9), cut(make_recording(3), 3.0, 5.9)
    far = replace(second, source={"origin": [1e6, 0.0, 0.0]})
    with pytest.raises(InputError, match="another origin"):
        join_recordings([first, far], ["a", "b"], None)


def test_interleaved_scans_are_put_in_order(drive):
    joined = join_recordings([cut(drive, 0.0, 3.0), cut(drive, 2.95, 5.9)], ["a", "b"], None)
    np.testing.assert_array_equal(joined.stamp_ns, drive.stamp_ns)
    scans = [3, 1, 2, 0]
    rows = np.concatenate([np.arange(N) + N * k for k in scans])
    late = replace(cut(drive, 0.0, 0.3), stamp_ns=drive.stamp_ns[:4] + 50_000_000)
    joined = join_recordings([cut(drive, 0.0, 0.3), late], ["a", "b"], None)
    assert np.all(np.diff(joined.stamp_ns) > 0)
    np.testing.assert_array_equal(joined.points[: 2 * N], np.tile(drive.points[:N], (2, 1)))
    assert len(rows) == 4 * N


def test_a_raw_kitti_drive_in_pieces(tmp_path):
    whole = tmp_path / "whole"
    rng = np.random.default_rng(1)
    scans = [rng.uniform(-9.0, 9.0, (30, 4)).astype("<f4") for _ in range(20)]
    stamps = [f"2011-09-26 13:02:{25 + 0.1037 * k:012.9f}" for k in range(20)]
    for folder, rows in (
        (whole, range(20)),
        (tmp_path / "a", range(9)),
        (tmp_path / "b", range(9, 20)),
    ):
        (folder / "velodyne_points/data").mkdir(parents=True)
        for number, k in enumerate(rows):
            scans[k].tofile(folder / f"velodyne_points/data/{number:010d}.bin")
        text = "".join(f"{stamps[k]}\n" for k in rows)
        (folder / "velodyne_points/timestamps.txt").write_text(text)
    joined = inputs.read([tmp_path / "b", tmp_path / "a"])
    require_equal(joined, read(whole))
    assert joined.beam_time is not None
    shutil.rmtree(tmp_path / "b")
