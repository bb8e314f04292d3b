"""What is written and shown of what moved."""

import dataclasses
import json

import numpy as np
import pytest

from stillmap.results.objects import write_objects, write_ply, write_traffic
from stillmap.results.report.figures import draw_map, map_window
from stillmap.results.report.maps import draw_traffic
from stillmap.results.report.page import render_report
from stillmap.tracking import ObjectOptions, compute_flow_map


def read_ply(path):
    """The vertices as a structured array, by the format's own description."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    kind, what, n = lines[2].split()
    assert (kind, what) == ("element", "vertex")
    assert all(line.startswith("property float ") for line in lines[3:])
    vertices = np.frombuffer(body, [(line.split()[-1], "<f4") for line in lines[3:]])
    assert len(vertices) == int(n)
    return vertices


def test_the_list_says_all_that_is_known(tmp_path, result):
    write_objects(tmp_path / "objects", result)
    written = json.loads((tmp_path / "objects/objects.json").read_text())
    assert len(written) == len(result.objects) == 2
    for record, one in zip(written, result.objects, strict=True):
        assert record["id"] == one.id
        assert record["first_stamp_ns"] == record["track"]["stamp_ns"][0] == one.stamp_ns[0]
        assert record["last_stamp_ns"] == record["track"]["stamp_ns"][-1] == one.stamp_ns[-1]
        assert record["size"] == [0.5, 0.3]
        assert record["beams"] == len(one.beams)
        assert record["p_dynamic"] == 0.9
        assert record["p_identity"] == 1.0
        track = record["track"]
        assert set(track) == {"stamp_ns", "x", "y", "vx", "vy"}
        np.testing.assert_allclose(np.transpose([track["x"], track["y"]]), one.xy, atol=6e-4)
        np.testing.assert_allclose(np.transpose([track["vx"], track["vy"]]), one.velocity)


def test_the_points_lie_where_the_map_has_them(tmp_path, result):
    write_objects(tmp_path / "objects", result)
    recording = result.recording
    T = recording.T_map_sensor(result.poses)
    scan = np.repeat(np.arange(recording.n_scans), np.diff(recording.offset))
    for one in result.objects:
        found = read_ply(tmp_path / f"objects/{one.id:04d}.ply")
        for k in (0, len(one.beams) // 2, len(one.beams) - 1):
            beam = one.beams[k]
            expected = T[scan[beam]] @ [*recording.points[beam].astype(float), 1.0]
            np.testing.assert_allclose([found["x"][k], found["y"][k]], expected[:2], atol=1e-4)
            assert found["z"][k] == 0.0
            assert found["p_dynamic"][k] == pytest.approx(1.0 - result.p_static[beam], abs=1e-6)
            since = 1e-9 * (recording.stamp_ns[scan[beam]] - one.stamp_ns[0])
            assert found["seconds"][k] == pytest.approx(since, abs=1e-3)


def test_nothing_moved(tmp_path, result):
    nothing = dataclasses.replace(result, objects=[], traffic=compute_flow_map([]))
    write_objects(tmp_path / "objects", nothing)
    assert json.loads((tmp_path / "objects/objects.json").read_text()) == []
    assert [path.name for path in (tmp_path / "objects").iterdir()] == ["objects.json"]
    write_traffic(tmp_path / "traffic.npz", nothing.traffic)
    with np.load(tmp_path / "traffic.npz", allow_pickle=False) as read:
        assert read["crossings"].shape == (0, 0)
    assert "No moving object was tracked" in render_report(nothing)


def test_empty_clouds_are_clouds(tmp_path):
    write_ply(tmp_path / "none.ply", np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.float32))
    assert len(read_ply(tmp_path / "none.ply")) == 0


def test_traffic_file(tmp_path, result):
    write_traffic(tmp_path / "traffic.npz", result.traffic)
    with np.load(tmp_path / "traffic.npz", allow_pickle=False) as read:
        assert set(read) == {"crossings", "speed", "origin", "resolution"}
        np.testing.assert_array_equal(read["crossings"], result.traffic.crossings)
        np.testing.assert_array_equal(read["speed"], result.traffic.speed)
        assert read["origin"].tolist() == list(result.traffic.origin)
        assert float(read["resolution"]) == 0.5


def test_report_shows_every_track(result, section):
    text = section(render_report(result), "Moving objects")
    assert text.count("<polyline") == len(result.objects)
    assert text.count("<tr>") == 1 + len(result.objects)
    assert "2 objects were tracked" in text
    off = dataclasses.replace(result.options, objects=ObjectOptions(enabled=False))
    html = render_report(dataclasses.replace(result, options=off))
    assert section(html, "Moving objects") == ""


def test_squares_are_darker_where_more_crossed(result):
    window = map_window([result.map])
    picture = draw_map(result.map, window)
    image = np.array(draw_traffic(result.traffic, picture, window).convert("RGB")).astype(int)
    plain = np.array(picture.convert("RGB")).astype(int)
    changed = (np.abs(image - plain).max(axis=2) > 30) & (image[..., 0] - image[..., 2] > 40)
    x0, _, _, y1 = window
    step = (window[2] - x0) / picture.size[0]
    rows, columns = np.nonzero(changed)
    x, y = x0 + (columns + 0.5) * step, y1 - (rows + 0.5) * step
    t = result.traffic
    j = np.floor((x - t.origin[0]) / t.resolution).astype(int)
    i = np.floor((y - t.origin[1]) / t.resolution).astype(int)
    assert len(rows) > 100
    assert (t.crossings[i, j] > 0).all()  # and nowhere else
    walls = plain.max(axis=2) < 60
    assert not (changed & walls).any()
