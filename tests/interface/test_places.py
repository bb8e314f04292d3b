"""Places in Python: merged, saved, loaded, shown."""

import gc
import inspect
import json
import os
import shutil

import numpy as np
import pytest
from flat import OPTIONS, files_of

import stillmap
from stillmap.core.source import Source


@pytest.fixture(scope="module")
def merged(flat_days):
    """The place of `map1` and `map2`, in a folder that goes with it."""
    return stillmap.merge([flat_days / "map1", str(flat_days / "map2")], options=OPTIONS)


def test_what_a_place_has(merged, flat_days):
    assert isinstance(merged, stillmap.Result)
    assert isinstance(merged, stillmap.Result)
    first, second = merged.sessions
    assert (first.name, first.input, first.accepted) == ("map1", str(flat_days / "map1"), True)
    np.testing.assert_allclose(first.T_place_session, np.eye(3), atol=1e-3)
    assert not first.covariance.any()
    assert (first.overlap, second.overlap > 0.2) == (1.0, True)
    assert (np.linalg.eigvalsh(second.covariance) > 0.0).all()
    assert (first.scans, second.scans) == (slice(0, 100), slice(100, 200))
    # the robot started the second day where T_place_session says
    T = merged.poses[second.scans][0] @ np.linalg.inv(second.T_place_session)
    np.testing.assert_allclose(T[:2, 2], 0.0, atol=0.2)
    (change,) = merged.changes
    assert change.kind == "appeared"
    assert change.between == ("map1", "map2")
    # a chest of 0.8 m about (0.5, 2.5), seen from a start at (-5, 0)
    np.testing.assert_allclose(change.box, (5.1, 2.1, 5.9, 2.9), atol=0.15)
    assert 0.5 < change.probability <= 1.0
    assert merged.p_static.shape == merged.hit.shape == (72_000,)
    assert merged.map.p_occupied.shape == merged.map.occupied.shape
    assert merged.options.threads == 1
    assert merged.warnings == []


def test_a_session_alone(merged, flat_days):
    day = merged.load_session("map2")
    np.testing.assert_array_equal(day.poses, merged.poses[merged.sessions[1].scans])
    np.testing.assert_array_equal(day.map.p_occupied, merged.map.p_occupied)
    np.testing.assert_array_equal(day.recording.points, stillmap.read(flat_days / "day2").points)
    again = merged.load_session("map2", recording=stillmap.read(flat_days / "day2"))
    np.testing.assert_array_equal(again.deskewed.points, day.deskewed.points)
    with pytest.raises(stillmap.InputError, match=r"no session map9 \(there are map1, map2"):
        merged.load_session("map9")
    with pytest.raises(stillmap.InputError, match=r"several recordings \(load_session"):
        merged.recording  # noqa: B018
    with pytest.raises(stillmap.InputError, match=r"several recordings \(load_session"):
        stillmap.load(merged.path, recording=flat_days / "day1")


def test_saved_and_loaded(merged, flat_place, tmp_path):
    merged.save(tmp_path / "place")
    assert files_of(tmp_path / "place") == files_of(flat_place)  # merged with the same options
    loaded = stillmap.load(tmp_path / "place")
    assert isinstance(loaded, stillmap.Result)
    assert loaded.changes == merged.changes
    np.testing.assert_array_equal(loaded.poses, merged.poses)
    with pytest.raises(stillmap.InputError, match="overwrite=True"):
        merged.save(tmp_path / "place")
    for name in ("sessions.json", "changes.json"):
        whole = (tmp_path / "place" / name).read_text()
        for wrong in ("", whole[:-20], whole.replace("[", "{"), "[1]", '{"name": 3}'):
            (tmp_path / "place" / name).write_text(wrong)
            with pytest.raises(stillmap.InputError, match=name):
                stillmap.load(tmp_path / "place")
        (tmp_path / "place" / name).write_text(whole)
    records = json.loads((tmp_path / "place" / "sessions.json").read_text())
    records[1]["first_scan"] = 7
    (tmp_path / "place" / "sessions.json").write_text(json.dumps(records))
    with pytest.raises(stillmap.InputError, match="its scans are not those of the place"):
        stillmap.load(tmp_path / "place")


@pytest.mark.slow
def test_recordings_and_results_themselves(flat_days, flat_place):
    """Their labels are those of the files, to the bit."""
    recording = stillmap.read(flat_days / "day1")
    nowhere = stillmap.Recording(**{**vars(recording), "source": Source()})
    built = stillmap.build(flat_days / "day2", OPTIONS)
    for first, names in (
        (nowhere, ["session", "day2"]),
        (stillmap.load(flat_days / "map1"), ["map1", "day2"]),
    ):
        place = stillmap.merge([first, built], options=OPTIONS)
        assert [one.name for one in place.sessions] == names
        for name in ("map.npz", "trajectory.tum", "beams/p_static.npy"):
            assert (place.path / name).read_bytes() == (flat_place / name).read_bytes()


@pytest.mark.slow
def test_parts_of_one_run(flat_days, tmp_path):
    from stillmap.io import write

    whole = stillmap.read(flat_days / "day2")
    middle = 50
    for name, scans in (("a", slice(0, middle)), ("b", slice(middle, None))):
        beams = whole.beams_of(range(*scans.indices(100))[0]).start
        end = whole.beams_of(range(*scans.indices(100))[-1]).stop
        part = stillmap.Recording(
            **{
                **vars(whole),
                "stamp_ns": whole.stamp_ns[scans],
                "offset": whole.offset[scans.start : (scans.stop or 100) + 1] - beams,
                "points": whole.points[beams:end],
                "hit": whole.hit[beams:end],
                "sensor": whole.sensor[scans],
                "T_odom_base": whole.T_odom_base[scans],
            }
        )
        write(part, tmp_path / name)
    place = stillmap.merge([flat_days / "map1", [tmp_path / "a", tmp_path / "b"]], options=OPTIONS)
    assert [one.name for one in place.sessions] == ["map1", "a"]
    assert place.sessions[1].scans == slice(100, 200)


@pytest.mark.slow
def test_growing_without_the_recordings(merged, flat_days, tmp_path):
    """What the place keeps is enough."""
    before, days = files_of(merged.path), tmp_path / "flat"
    shutil.copytree(flat_days, days)
    place = stillmap.merge([days / "map1", days / "map2"], options=OPTIONS)
    shutil.rmtree(days)
    alike = stillmap.merge([place, flat_days / "map3"], options=OPTIONS)
    grown = stillmap.merge(
        [merged, flat_days / "map3"], options=OPTIONS, output=tmp_path / "out", frame="map3"
    )
    assert grown.path == tmp_path / "out"
    assert files_of(merged.path) == before
    np.testing.assert_allclose(grown.sessions[2].T_place_session, np.eye(3), atol=1e-9)
    turn = grown.sessions[0].T_place_session
    for one, other in zip(alike.sessions, grown.sessions, strict=True):
        np.testing.assert_allclose(turn @ one.T_place_session, other.T_place_session, atol=1e-6)
    np.testing.assert_allclose(turn @ alike.poses, grown.poses, atol=1e-6)


def test_the_temporary_folder_goes_with_the_place(flat_days, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    place = stillmap.merge([flat_days / "map1", flat_days / "map2"], options=OPTIONS)
    assert place.path.is_dir()
    poses, session = place.poses, place.load_session("map1")
    del place
    gc.collect()
    assert os.listdir(tmp_path) == []
    assert len(poses) == 200
    assert session.p_static[0] >= 0.0  # what is mapped stays
    with pytest.raises(stillmap.InputError):
        stillmap.merge([flat_days / "map1", tmp_path / "no"], options=OPTIONS)
    with pytest.raises(stillmap.InputError):
        stillmap.merge([flat_days / "map1", flat_days / "map2"], options=OPTIONS, frame="no")
    assert os.listdir(tmp_path) == []


def test_a_place_is_shown(merged):
    assert repr(merged) == (
        f"<Result: 2 of 2 sessions with 200 scans with {len(merged.hit)} beams, "
        f"{len(merged.objects)} moving objects, 1 change between them, 0 warnings, {merged.map!r}>"
    )
    page = merged._repr_html_()
    assert "src='data:image/png;base64," in page
    assert "2 of 2 sessions with 200 scans" in page
    assert len(repr(merged.sessions[0])) < 400


def test_plot(merged):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    ax = merged.plot(dynamic=True)
    *points, first, second = ax.get_lines()
    np.testing.assert_allclose(first.get_xydata(), merged.poses[:100, :2, 2])
    np.testing.assert_allclose(second.get_xydata(), merged.poses[100:, :2, 2])
    dynamic = merged.hit & (merged.p_static < 0.5)
    assert sum(len(one.get_xydata()) for one in points) == dynamic.sum()
    (box,) = ax.patches
    np.testing.assert_allclose(
        [*box.get_xy(), box.get_width()], [*merged.changes[0].box[:2], 0.8], atol=0.1
    )
    assert not merged.plot(changes=False, trajectory=False).get_lines()
    pyplot.close("all")


def test_tables(merged):
    pytest.importorskip("pandas")
    assert len(merged.to_dataframe("poses")) == 200
    assert len(merged.to_dataframe("objects")) == len(merged.objects)
    with pytest.raises(stillmap.InputError, match="several recordings"):
        merged.to_dataframe("beams")


def test_what_merge_takes(flat_days):
    parameters = inspect.signature(stillmap.merge).parameters
    assert next(iter(parameters)) == "sessions"
    keywords = [name for name, one in parameters.items() if one.kind is one.KEYWORD_ONLY]
    assert keywords == [
        *("options", "frame", "map_state", "odometry", "output", "overwrite", "progress"),
    ]
    with pytest.raises(TypeError, match="expected a list of sessions"):
        stillmap.merge(str(flat_days / "map1"))
    heard = []
    stillmap.merge(
        [flat_days / "map1", flat_days / "map2"],
        options=OPTIONS,
        progress=lambda stage, *_: heard.append(stage),
    )
    assert "map2: aligning" in heard
    assert heard[-1] == "merging"
