"""Returns from farther away than lasers reach, which took memory for all cells on their way."""

import dataclasses

import numpy as np
import pytest
from choices import options

import stillmap
from stillmap.cli.main import main
from stillmap.io.stillmap_folder import write
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams

FAR = 900.0  # m


def spoil(recording):
    """Every third beam ends at FAR."""
    points = recording.points.copy()
    far = slice(None, None, 3)
    points[far] *= FAR / np.linalg.norm(points[far], axis=1, keepdims=True)
    hit = recording.hit.copy()
    hit[far] = True
    return dataclasses.replace(recording, points=points, hit=hit)


def is_small(grid):
    return max(grid.p_occupied.shape) * grid.resolution < 50.0


def test_a_map_has_what_is_near(short):
    spoiled = spoil(short.recording)
    result = stillmap.build(spoiled, options(max_iterations=1))
    assert is_small(result.map)
    assert (np.asarray(result.map.p_occupied) > 0.5).sum() > 50
    (sentence,) = (one for one in result.warnings if "farther than 100 m" in one)
    assert sentence.startswith(f"{len(spoiled.hit[::3])} of {spoiled.hit.sum()} returns")


def test_a_result_knows_its_recording(short, tmp_path):
    spoiled, out = spoil(short.recording), tmp_path / "map"
    write(spoiled, tmp_path / "log")
    result = stillmap.build(stillmap.read(tmp_path / "log"), options(max_iterations=1))
    result.save(out)
    opened = stillmap.load(out)
    np.testing.assert_array_equal(opened.recording.hit, result.recording.hit)
    np.testing.assert_array_equal(opened.recording.points, result.recording.points)
    assert not opened.recording.hit[::3].any()
    other = dataclasses.replace(spoiled, hit=np.arange(len(spoiled.hit)) % 3 == 0)
    with pytest.raises(stillmap.InputError, match="is not the recording that was mapped"):
        _ = stillmap.load(out, recording=other).recording


def test_a_filtered_copy_keeps_what_has_no_label(short, tmp_path):
    spoiled = spoil(short.recording)
    write(spoiled, tmp_path / "log")
    words = [str(tmp_path / "log"), "-o", str(tmp_path / "map"), "--threads", "1", "--quiet"]
    assert main(["map", *words]) == 0
    words = [str(tmp_path / "map"), "-o", str(tmp_path / "copy"), "--to", "stillmap", "--quiet"]
    assert main(["filter", *words]) == 0
    copy = stillmap.read(tmp_path / "copy")
    np.testing.assert_array_equal(copy.points[::3], spoiled.points[::3])


def test_so_has_the_map_of_a_drive(short):
    spoiled = spoil(short.recording)
    with LiveMapper({"threads": 1}) as mapper:
        for beams, odometry in zip(iter_beams(spoiled), spoiled.T_odom_base, strict=True):
            mapper.push(beams, odometry)
        assert is_small(mapper.map)
        assert (mapper.map.p_occupied > 0.5).sum() > 50
