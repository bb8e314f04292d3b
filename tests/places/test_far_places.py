"""Sessions whose map frame begins far away: the place has the frame of the first one.

Alignment makes up to a tenth of a millimetre of rounding errors.
"""

import json

import numpy as np
import pytest
import yaml
from flat import OPTIONS

import stillmap
from stillmap.cli.main import main
from stillmap.io.trajectory import read_tum
from stillmap.results.reader import read_grid, read_tracks

UTM = np.array([448_262.37, 5_411_932.713])


@pytest.fixture(scope="module")
def far_places(flat_days, tmp_path_factory):
    """Places of two days: of results, and of the first one with poses in a projection."""
    folder = tmp_path_factory.mktemp("far")
    poses = stillmap.load(flat_days / "map1").poses
    for name, by in (("near", np.zeros(2)), ("far", UTM)):
        moved = poses.copy()
        moved[:, :2, 2] += by
        stillmap.build(flat_days / "day1", OPTIONS, poses=moved).save(folder / f"{name}1")
        words = [str(folder / f"{name}1"), str(flat_days / "map2"), "-o", str(folder / name)]
        assert main(["merge", *words, "--quiet", "--threads", "1"]) == 0
    return folder


def test_trajectories_and_map_are_in_the_frame_of_the_first_session(far_places):
    near, far = (read_tum(far_places / name / "trajectory.tum")[1] for name in ("near", "far"))
    np.testing.assert_allclose(far[:, :2, 3] - UTM, near[:, :2, 3], rtol=0, atol=1e-3)
    maps = [read_grid(far_places / name) for name in ("near", "far")]
    np.testing.assert_allclose(np.array(maps[1].origin[:2]) - UTM, maps[0].origin[:2], atol=1e-6)
    assert maps[0].p_occupied.shape == maps[1].p_occupied.shape
    assert np.mean(maps[0].occupied != maps[1].occupied) < 1e-3
    described = yaml.safe_load((far_places / "far" / "map.yaml").read_text())
    assert described["origin"] == pytest.approx(maps[1].origin, abs=1e-6)


@pytest.mark.parametrize("kinds", [("near1", "far1"), ("near", "far")])
def test_no_label_flips(far_places, kinds):
    near, far = (np.load(far_places / kind / "beams" / "p_static.npy") for kind in kinds)
    usable = ~np.isnan(near)
    np.testing.assert_array_equal((far > 0.5)[usable], (near > 0.5)[usable])


def test_transforms_lead_from_the_map_of_each_result(far_places):
    near, far = (
        json.loads((far_places / name / "sessions.json").read_text()) for name in ("near", "far")
    )
    np.testing.assert_allclose(far[0]["T_place_session"], np.eye(3), atol=1e-6)
    moved = np.array(near[1]["T_place_session"])
    moved[:2, 2] += UTM
    np.testing.assert_allclose(far[1]["T_place_session"], moved, atol=1e-4)


def test_changes_and_objects(far_places):
    near, far = (
        json.loads((far_places / name / "changes.json").read_text()) for name in ("near", "far")
    )
    assert near
    for one, other in zip(near, far, strict=True):
        assert one["kind"] == other["kind"]
        np.testing.assert_allclose(np.array(other["box"]) - np.tile(UTM, 2), one["box"], atol=2e-3)
    cells = [np.load(far_places / name / "changes.npz")["xy"] for name in ("near", "far")]
    np.testing.assert_allclose(cells[1] - UTM, cells[0], atol=1e-6)
    states = [np.load(far_places / name / "states.npz") for name in ("near", "far")]
    by = np.round(UTM / states[0]["resolution"]).astype(int)
    np.testing.assert_array_equal(states[1]["cells"] - by, states[0]["cells"])
    tracks = [
        read_tracks(far_places / name / "objects" / "objects.json") for name in ("near", "far")
    ]
    assert len(tracks[0]) == len(tracks[1])
    for track, moved in zip(*tracks, strict=True):
        np.testing.assert_allclose(moved.xy - UTM, track.xy, atol=2e-3)


def test_it_grows(far_places, flat_days, tmp_path):
    words = [str(far_places / "far"), str(flat_days / "map3"), "-o", str(tmp_path / "more")]
    assert main(["merge", *words, "--quiet", "--threads", "1"]) == 0
    found = json.loads((tmp_path / "more" / "sessions.json").read_text())
    assert [one["accepted"] for one in found] == [True] * 3
    assert np.abs(np.array(found[2]["T_place_session"])[:2, 2] - UTM).max() < 20.0
