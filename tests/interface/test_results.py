"""Results in Python: built, saved, loaded, shown, as tables."""

import dataclasses
import html
import json
import re

import numpy as np
import pytest

import stillmap
from stillmap.cli.main import main
from stillmap.core import se2
from stillmap.core.source import Source
from stillmap.io import write

SHORT = 400  # characters of a `repr`


def test_a_loaded_result_has_what_the_built_one_has(built, saved):
    loaded = stillmap.load(saved)
    assert isinstance(loaded, stillmap.Result)
    assert isinstance(built, stillmap.Result)
    np.testing.assert_array_equal(loaded.p_static, built.p_static)
    np.testing.assert_array_equal(loaded.hit, built.hit)
    np.testing.assert_array_equal(loaded.stamp_ns, built.stamp_ns)
    np.testing.assert_array_equal(loaded.map.p_occupied, built.map.p_occupied)
    np.testing.assert_allclose(loaded.poses, built.poses, atol=1e-8)
    assert loaded.options == built.options
    assert loaded.warnings == built.warnings
    assert loaded.run == built.run
    assert [one.id for one in loaded.objects] == [one.id for one in built.objects]
    np.testing.assert_array_equal(loaded.recording.points, built.recording.points)
    np.testing.assert_array_equal(loaded.deskewed.points, built.deskewed.points)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_map_without_cells(dimension, tmp_path):
    """Of a recording without a return, the map shows nothing."""
    stamps = np.arange(3.0)
    if dimension == 2:
        ranges = np.full((3, 9), np.nan)
        recording = stillmap.Recording.from_scans(stamps, ranges, np.linspace(-1.0, 1.0, 9))
    else:
        recording = stillmap.Recording.from_clouds(stamps, [np.zeros((0, 3))] * 3)
    result = stillmap.build(recording, {"threads": 1})
    assert result.map.p_occupied.size == 0
    result.save(tmp_path / "map")
    for one in (result, stillmap.load(tmp_path / "map", recording=recording)):
        assert "3 scans with" in one._repr_html_()
        assert one.plot().get_aspect() == 1.0


def test_a_part_of_the_options_and_a_resolution(built):
    assert built.options.slam.resolution == built.map.resolution == 0.1
    assert (built.options.threads, built.options.em.max_iterations) == (1, 2)
    with pytest.raises(stillmap.InputError, match=r"unknown option 'em.priro' \(nearest: 'em.prio"):
        stillmap.build(built.recording, {"em.priro": 0.5})
    with pytest.raises(stillmap.InputError, match="resolution' must be"):
        stillmap.build(built.recording, resolution=-1.0)
    with pytest.raises(TypeError, match="options: expected Options or a mapping, got list"):
        stillmap.build(built.recording, ["em.prior=0.5"])


def test_poses_are_kept_in_every_form(built, folder, saved):
    x, y = built.poses[:, :2, 2].T
    theta = np.arctan2(built.poses[:, 1, 0], built.poses[:, 0, 0])
    options = {"threads": 1, "em.max_iterations": 1, "slam.resolution": 0.2}
    for poses in (built.poses, np.stack([x, y, theta], axis=1), saved / "trajectory.tum"):
        result = stillmap.build(built.recording, options, poses=poses, odometry=False)
        np.testing.assert_allclose(result.poses, built.poses, atol=1e-8)
        assert result.recording.T_odom_base is None
    with pytest.raises(ValueError, match=r"poses: expected 60 as in recording, got 59"):
        stillmap.build(built.recording, poses=built.poses[1:])
    with pytest.raises(stillmap.InputError, match=r"states no poses \(poses=\"FILE.tum\" gives"):
        stillmap.build(folder, poses="recording")


def test_saving_twice_wants_overwrite(built, saved):
    with pytest.raises(stillmap.InputError, match="overwrite=True"):
        built.save(saved)
    before = json.loads((saved / "run.json").read_text())
    built.save(saved, overwrite=True)
    assert json.loads((saved / "run.json").read_text()) == before


def test_a_saved_result_is_copied_whole(saved, tmp_path):
    copy = tmp_path / "copy"
    stillmap.load(saved).save(copy)
    names = [sorted(str(p.relative_to(one)) for p in one.rglob("*")) for one in (saved, copy)]
    assert names[0] == names[1]
    with pytest.raises(stillmap.InputError, match="overwrite=True"):
        stillmap.load(saved).save(tmp_path / "copy")
    with pytest.raises(stillmap.InputError, match="is the result itself, or inside"):
        stillmap.load(saved).save(saved / "objects" / "copy")


def test_a_recording_from_arrays_is_named_when_loading(built, tmp_path):
    nowhere = stillmap.Recording(**{**vars(built.recording), "source": Source()})
    stillmap.build(nowhere, {"threads": 1, "em.max_iterations": 1}, resolution=0.2).save(tmp_path)
    loaded = stillmap.load(tmp_path)
    assert len(loaded.p_static) == nowhere.n_beams
    with pytest.raises(stillmap.InputError, match=r"names no recording .*recording=PATH"):
        loaded.recording  # noqa: B018
    assert stillmap.load(tmp_path, recording=nowhere).recording.n_beams == nowhere.n_beams
    other = stillmap.Recording(**{**vars(nowhere), "stamp_ns": nowhere.stamp_ns + 1})
    with pytest.raises(stillmap.InputError, match="is not the recording that was mapped"):
        stillmap.load(tmp_path, recording=other).recording  # noqa: B018


def test_no_result(tmp_path):
    with pytest.raises(stillmap.InputError, match="cannot be read"):
        stillmap.load(tmp_path)


def parts_of(value, seen):
    """All values below a result that are of this package's classes."""
    if id(value) in seen or not type(value).__module__.startswith("stillmap"):
        return
    seen[id(value)] = value
    for inner in getattr(value, "__dict__", {}).values():
        for one in inner if isinstance(inner, list | tuple) else [inner]:
            parts_of(one, seen)


def test_every_repr_is_short(built, saved):
    loaded, seen = stillmap.load(saved), {}
    for one in (built, loaded, loaded.recording, built.map, built.graph, built.evidence):
        parts_of(one, seen)
    names = {type(value).__name__ for value in seen.values()}
    assert {"Recording", "OccupancyMap", "Estimate", "MovingObject", "MStepResult"} <= names
    long = {
        type(value).__name__: len(repr(value))
        for value in seen.values()
        if len(repr(value)) > SHORT
    }
    assert {name for name in long if not name.endswith("Options")} == set()
    assert repr(built.recording) == "<Recording: 60 scans with 10800 beams in 2D, 11.8 s, odometry>"
    assert re.fullmatch(
        r"<Result: 60 scans with 10800 beams, \d+ moving objects?, \d+ warnings?, "
        r"<OccupancyMap: \d+ x \d+ cells of 0.1 m, [\d.]+ m x [\d.]+ m>>",
        repr(built),
    )


def test_a_notebook_shows_map_and_facts(built, saved):
    for result in (built, stillmap.load(saved)):
        page = result._repr_html_()
        assert "src='data:image/png;base64," in page
        assert html.escape(repr(result)) in page
        assert len(page) < 100_000
        assert "recording" not in vars(result) or result is built  # nothing had to be read


def test_plot_is_in_metres(built, saved):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    ax = stillmap.load(saved).plot(dynamic=True)
    assert ax.get_aspect() == 1.0
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x (m)", "y (m)")
    points, way = ax.get_lines()
    np.testing.assert_allclose(way.get_xydata(), built.poses[:, :2, 2], atol=1e-6)
    dynamic = built.recording.hit & (built.p_static < 0.5)
    assert len(points.get_xydata()) == dynamic.sum()
    # the darkest pixels lie where the map is occupied
    image = ax.get_images()[0]
    left, right, _, top = image.get_extent()
    pixels = np.asarray(image.get_array())[..., 0]
    row, column = np.argwhere(pixels < 40)[0]
    edge = (right - left) / pixels.shape[1]
    x, y = left + (column + 0.5) * edge, top - (row + 0.5) * edge
    j, i = np.floor((np.array([x, y]) - built.map.origin[:2]) / built.map.resolution).astype(int)
    assert built.map.p_occupied[i, j] > 0.65
    _, given = pyplot.subplots()
    assert built.plot(given, trajectory=False) is given
    assert not given.get_lines()
    pyplot.close("all")


def test_tables(built, saved):
    pytest.importorskip("pandas")
    beams = built.to_dataframe()
    assert len(beams) == built.recording.n_beams
    np.testing.assert_array_equal(beams["p_static"], built.p_static)
    ends = built.deskewed.end_points(np.arange(len(beams)), built.poses)
    np.testing.assert_allclose(beams[["x", "y"]], ends, rtol=1e-5, atol=1e-5)
    objects, tracks = built.to_dataframe("objects"), built.to_dataframe("tracks")
    assert objects["beams"].tolist() == [len(one.beams) for one in built.objects]
    assert len(tracks) == sum(len(one.xy) for one in built.objects)
    poses = built.to_arrow("poses")
    assert poses.column_names == ["stamp_ns", "x", "y", "theta"]
    for name in ("beams", "poses", "objects", "tracks"):
        again = stillmap.load(saved).to_arrow(name)
        assert again.schema == built.to_arrow(name).schema
        assert len(again) == len(built.to_arrow(name))
    with pytest.raises(
        ValueError, match=r"table: expected one of 'beams', 'poses', .* got 'scans'"
    ):
        built.to_arrow("scans")


def test_calibrated_mounts_are_those_of_the_map_again(tmp_path):
    """The laser is recorded as turned by 0.4 rad, and looks straight ahead."""
    scene = ["simulate", "hall", "-o", str(tmp_path / "hall"), "--scans", "200", "--quiet"]
    assert main(scene) == 0
    recording = stillmap.read(tmp_path / "hall")
    turned = dataclasses.replace(recording, T_base_sensor=se2.matrix([0.0], [0.0], [0.4]))
    write(turned, tmp_path / "turned")
    options = {"threads": 1, "em.max_iterations": 1}
    built = stillmap.build(tmp_path / "turned", options, resolution=0.2)
    assert abs(se2.parameters(built.recording.T_base_sensor[0])[2]) < 0.02
    built.save(tmp_path / "out")
    loaded = stillmap.load(tmp_path / "out")
    np.testing.assert_array_equal(loaded.recording.T_base_sensor, built.recording.T_base_sensor)
    np.testing.assert_array_equal(loaded.recording.T_odom_base, built.recording.T_odom_base)
    # exports put the beams where the map has them, too
    table = tmp_path / "beams.parquet"
    assert main(["convert", str(tmp_path / "out"), "-o", str(table), "--quiet"]) == 0
    x = pytest.importorskip("pyarrow.parquet").read_table(table)["x"].to_numpy()
    np.testing.assert_allclose(x, built.to_arrow()["x"].to_numpy(), atol=1e-4)
