"""`stillmap info`: text and JSON."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from stillmap.cli.parser import parser
from stillmap.core.camera import Camera, Images
from stillmap.core.recording import Recording
from stillmap.io import read, write

LINES = [
    "# CARMEN Logfile",
    "PARAM robot_frontlaser_offset 0.25 host 0",
    "FLASER 4 1 2 3 81.83 0 0 0 0 0 0 100.0 host 0.1",
    "FLASER 4 1 2 3",
    "FLASER 4 1 2 nan 4 3 4 0.5 3 4 0.5 101.5 host 0.1",
    "FLASER 4 1 2 3 4 3 4 0.5 3 4 0.5 102.0 host 0.1",
    "ODOM 0 0 nan 0 0 0 1 host 0",
]


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "tiny.log"
    file.write_text("".join(f"{line}\n" for line in LINES))
    return file


def run(*arguments):
    args = parser(["info"]).parse_args(["info", *map(str, arguments)])
    return args.run(args)


def test_json(path, capsys):
    assert run(path, "--json") == 0
    out, err = capsys.readouterr()
    assert err == ""
    found = json.loads(out)
    assert (found["scans"], found["beams"], found["format"]) == (3, 12, "carmen")
    assert found["counts"]["hits"] == 10
    assert found["counts"]["max_range"] == 1
    assert found["counts"]["unusable"] == 1
    # hits 1 2 3 1 2 4 1 2 3 4, the lower of two middle values
    assert found["hit_ranges_m"] == {"min": 1.0, "median": 2.0, "p99": 4.0, "max": 4.0}
    assert found["time"]["first_stamp_ns"] == 100 * 10**9
    assert found["time"]["duration_s"] == 2.0
    assert found["time"]["rate_hz"] == 1.0
    assert found["time"]["largest_gap_s"] == 1.5
    assert found["odometry"]["path_length_m"] == pytest.approx(5.0)
    assert found["odometry"]["largest_step_m"] == pytest.approx(5.0)
    assert found["odometry"]["largest_step_at_ns"] == 100 * 10**9
    (sensor,) = found["sensors"]
    assert sensor["extrinsics"]["x"] == 0.25
    assert sensor["field_of_view_deg"] == pytest.approx([-90.0, 45.0])
    assert sensor["ranges"]["threshold"] == 81.83
    assert found["skipped"] == {"line that cannot be read": {"count": 1, "lines": [4]}}
    assert found["skipped_odometry"] == {"line that cannot be read": {"count": 1, "lines": [7]}}


def test_text(path, capsys):
    assert run(path) == 0
    out = capsys.readouterr().out
    rows = {line[:22].strip(): line[24:] for line in reversed(out.splitlines())}
    assert out.startswith(f"{path}: carmen, 2D\n")
    for title, text in {
        "scans": "3",
        "beams_per_scan": "min 4, median 4, max 4",
        "shares": "hits 0.833333, max_range 0.0833333, unusable 0.0833333",
        "hit_ranges_m": "min 1, median 2, p99 4, max 4",
        "first_stamp_ns": "100000000000",
        "path_length_m": "5",
        "field_of_view_deg": "-90, 45",
        "angle_step": "0.785398",
        "extrinsics": "x 0.25, y 0, theta_deg 0, how PARAM",
        "params": "robot_frontlaser_offset 0.25",
    }.items():
        assert rows[title] == text, title
    assert re.search(r"skipped\n  line that cannot be read +count 1, lines 4\n", out)
    assert "81.83" in out
    assert "SICK overflow values" in out
    assert "warnings" in out


def test_flags_reach_the_reader(path, capsys):
    run(path, "--json", "--max-range", "2.5", "--min-range", "1.5", "--laser-offset", 1, 2, 90)
    found = json.loads(capsys.readouterr().out)
    assert found["counts"]["hits"] == 3
    assert found["counts"]["unusable"] == 4
    assert found["counts"]["max_range"] == 5
    place = found["sensors"][0]["extrinsics"]
    assert (place["x"], place["y"], place["theta_deg"]) == pytest.approx((1, 2, 90))


def test_upside_down_laser(path, capsys):
    run(path)
    assert re.search(r"upside_down +False\n", capsys.readouterr().out)
    run(path, "--laser-upside-down", "--laser-fov", "90")
    out = capsys.readouterr().out
    assert re.search(r"upside_down +True\n +upside_down_how +given", out)
    assert "-22.5, 45" in out
    run(path, "--json", "--laser-upside-down")
    (sensor,) = json.loads(capsys.readouterr().out)["sensors"]
    assert (sensor["upside_down"], sensor["upside_down_how"]) == (True, "given")


def test_recording_folder_gives_same_summary(path, tmp_path, capsys):
    write(read(path), tmp_path / "rec")
    run(path, "--json")
    run(tmp_path / "rec", "--json")
    first, second = capsys.readouterr().out.split("}\n{")
    log, folder = json.loads(first + "}"), json.loads("{" + second)
    assert log.pop("input") == str(path)
    assert folder.pop("input") == str(tmp_path / "rec")
    assert log == folder
    run(tmp_path / "rec")
    assert re.search(rf"made_from +{path}", capsys.readouterr().out)


@pytest.mark.parametrize(
    "source",
    [
        {},
        {"skipped": 3, "odometry": "yes", "sensors": [5], "warnings": {}, "params": []},
        {"skipped": {"a": 1}, "sensors": [{"ranges": {}, "extrinsics": 1, "start_angle": "x"}]},
    ],
)
def test_notes_of_other_writers(path, tmp_path, capsys, source):
    recording = read(path)
    write(recording, tmp_path / "rec")
    header = tmp_path / "rec/recording.json"
    header.write_text(json.dumps({**json.loads(header.read_text()), "source": source}))
    assert run(tmp_path / "rec") == 0
    assert "-90, 45\n" in capsys.readouterr().out


@pytest.mark.parametrize("scans", [0, 2])
def test_3d_recording(tmp_path, capsys, scans):
    points = np.tile(np.array([[3, 4, 0], [0, 0, 2]], np.float32), (scans, 1))
    recording = Recording(
        stamp_ns=np.arange(scans, dtype=np.int64),
        offset=2 * np.arange(scans + 1, dtype=np.int64),
        points=points,
        hit=np.ones(len(points), bool),
        T_base_sensor=np.eye(4)[None],
        sensor=np.zeros(scans, np.int32),
        T_odom_base=np.tile(np.eye(4), (scans, 1, 1)),
    )
    write(recording, tmp_path / "rec")
    assert run(tmp_path / "rec") == 0
    out = capsys.readouterr().out
    assert "3D" in out
    assert ("max 5\n" in out) == (scans > 0)
    assert run(tmp_path / "rec", "--json") == 0


def test_poses_and_images(path, tmp_path, capsys):
    recording = read(path)
    run(path)
    out = capsys.readouterr().out
    assert "recorded poses" not in out
    assert "cameras" not in out
    T = np.tile(np.eye(3), (3, 1, 1))
    T[:, 0, 2] = 0, 3, 7
    cameras = (
        Camera("front", 8, 6, np.eye(3), "", np.zeros(0), np.eye(4)),
        Camera("rear", 80, 60, None, "", np.zeros(0), None),
    )
    stamp_ns, camera = np.arange(5, dtype=np.int64), np.array([0, 1, 0, 0, 1], np.int32)
    images = Images(stamp_ns, camera, cameras, lambda _: np.zeros((6, 8), np.uint8))
    times = np.linspace(-0.05, 0.1, recording.n_beams).astype(np.float32)
    changes = {"T_recorded_base": T, "images": images, "beam_time": times}
    write(replace(recording, **changes), tmp_path / "rec")
    run(tmp_path / "rec")
    out = capsys.readouterr().out
    assert "-0.05, 0.1\n" in out
    assert re.search("recorded_poses +path_length_m 7, turned_deg 0", out)
    assert re.search("count +5\n +usable +0\n +left_out +of a 2D recording 5", out)
    words = "name front, count 3, usable 0, width 8, height 6, calibrated True, placed True"
    assert words in out
    assert (
        "name rear, count 2, usable 0, width 80, height 60, calibrated False, placed False" in out
    )
    run(tmp_path / "rec", "--json")
    found = json.loads(capsys.readouterr().out)
    assert found["recorded_poses"]["path_length_m"] == pytest.approx(7.0)
    assert (found["images"]["count"], found["images"]["cameras"][1]["count"]) == (5, 2)


def test_what_is_left_out_of_parts_that_overlap(tmp_path, capsys):
    scans = [f"FLASER 2 1 2 {x} 0 0 {x} 0 0 {100 + 2 * x} host 0.1\n" for x in range(9)]
    names = [tmp_path / "a.log", tmp_path / "b.log", tmp_path / "elsewhere.log"]
    for path, part in zip(names, (scans[:5], scans[3:], scans), strict=True):
        path.write_text("".join(part))
    assert run(*names[:2]) == 0
    ending = capsys.readouterr().out.rpartition("as one run")[2]
    assert re.search("scans +10\n +skipped\n +time running backwards +count 1, lines 5", ending)
    assert run(*names[:2], "--json") == 0
    found = json.loads(capsys.readouterr().out)["as_one_run"]
    assert found["scans"] == 10
    assert found["skipped"] == {"time running backwards": {"count": 1, "lines": [5]}}
    assert run(names[0], names[2]) == 0  # no parts of one run
    assert "as one run" not in capsys.readouterr().out
