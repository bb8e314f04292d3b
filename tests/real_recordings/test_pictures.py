"""Real recordings with pictures: do points and pixels belong together?"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import maximum_filter1d
from scipy.spatial.transform import Rotation

import stillmap
from stillmap.core import camera
from stillmap.mesh.views import View, find_views, read_color_image

pytestmark = pytest.mark.slow

slow = pytest.mark.slow


@pytest.fixture(scope="module")
def street(shared_data, tmp_path_factory):
    """Five sweeps of a lidar with a picture each, as a KITTI folder."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
    from unpacked import unpack

    pack = shared_data / "lidar3d" / "queue_000-039.npz"
    return stillmap.read(unpack(pack, tmp_path_factory.mktemp("street"), sweeps=5))


@pytest.fixture(scope="module")
def kitchen(shared_data):
    """A room before an RGB-D camera."""
    return stillmap.read(shared_data / "rgbd" / "kitchenette")


def steepness(recording: stillmap.Recording, view: View, scan: int, turned: float) -> float:
    """How much brighter or darker the picture gets where the scan's points leave for what is
    behind, with the camera turned aside by so many degrees."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("y", turned, degrees=True).as_matrix()
    view = replace(view, T_camera_map=turn @ view.T_camera_map)
    picture = read_color_image(recording.images, view)
    assert picture is not None
    change = np.abs(np.gradient(picture.mean(axis=2), axis=1))
    change = maximum_filter1d(change, 5, axis=1)  # beams are two or three pixels apart
    beams = np.arange(*recording.offset[[scan, scan + 1]])
    beams = beams[recording.hit[beams]]
    points = view.to_camera(recording.end_points(beams, recording.T_recorded_base))
    uv, ok = camera.project(view.camera, points)
    ok &= camera.is_in_image(view.camera, uv)
    depth, at = points[:, 2], np.round(np.where(ok[:, None], uv, 0.0)).astype(np.intp)
    # of beams one after the other, the one that ends much nearer
    both = np.flatnonzero(ok[:-1] & ok[1:])
    step = np.log(depth[both + 1] / depth[both])
    edge = both[np.abs(step) > 0.2] + (step[np.abs(step) > 0.2] < 0.0)
    assert len(edge) > 100
    return float(change[at[edge, 1], at[edge, 0]].mean())


def test_the_street_is_seen_where_its_points_are(street):
    views, left_out = find_views(street, street.T_recorded_base)
    assert (len(views), left_out) == (5, {})
    for scan in (0, 4):
        right, *wrong = (steepness(street, views[scan], scan, by) for by in (0.0, -2.0, 2.0))
        assert right > 1.2 * max(wrong)


@pytest.mark.slow
def test_the_room_is_seen_where_its_points_are(kitchen):
    views, left_out = find_views(kitchen, kitchen.T_recorded_base)
    assert (len(views), left_out) == (125, {})
    right = np.mean([steepness(kitchen, views[k], k, 0.0) for k in range(0, 125, 10)])
    for by in (-3.0, 3.0):
        assert right > 1.2 * np.mean(
            [steepness(kitchen, views[k], k, by) for k in range(0, 125, 10)]
        )


def test_the_room_is_level(kitchen):
    assert kitchen.source.details["levelled"]["by"] == "plane"
    hits = np.flatnonzero(kitchen.hit)[::50]
    height = kitchen.end_points(hits, kitchen.T_recorded_base)[:, 2]
    counts, edges = np.histogram(height, np.arange(-2.0, 0.6, 0.05))
    # a worktop, and the floor 0.7 m below it: nearly all that is below the floor is noise
    top, floor = edges[counts.argmax()], edges[counts[: counts.argmax() - 8].argmax()]
    assert 0.6 < top - floor < 0.8
    assert (height < floor - 0.1).mean() < 0.002


@slow
def test_a_room_without_people_is_static(kitchen):
    result = stillmap.build(kitchen, poses=kitchen.T_recorded_base)
    dynamic = result.p_static[kitchen.hit] < 0.5
    assert dynamic.mean() < 0.004
