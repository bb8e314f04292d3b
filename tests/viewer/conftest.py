"""A small result in the plane and one in space, as `stillmap map` writes them, with models."""

import json

import numpy as np
import pytest
from made_up_models import triangle_glb

from stillmap import io as recordings
from stillmap.core import se2
from stillmap.core.arrays import write_npz
from stillmap.io.trajectory import poses_from_tum, write_tum
from stillmap.results.point_cloud import write_clouds
from stillmap.results.viewer.scene import Beams, Scene
from stillmap.results.writer import write_labels
from stillmap.slam import SlamOptions

SCANS = 6
STAMPS = 1_700_000_000_000_000_000 + 500_000_000 * np.arange(SCANS)


@pytest.fixture
def glb():
    return triangle_glb()


@pytest.fixture
def result_of(tmp_path):
    """Makes a result of D dimensions and its recording; gives the folder."""

    def made(dimension, *, with_models=False, times=False):
        rng = np.random.default_rng(dimension)
        beams = 40
        points = rng.uniform(-5, 5, (SCANS * beams, dimension)).astype(np.float32)
        hit = rng.random(SCANS * beams) < 0.8
        n = dimension + 1
        poses = np.tile(np.eye(n), (SCANS, 1, 1))
        poses[:, :2, :2] = se2.matrix(0, 0, 0.1 * np.arange(SCANS))[:, :2, :2]
        poses[:, 0, -1] = np.arange(SCANS)
        T_base_sensor = np.eye(n)[None].copy()
        T_base_sensor[0, 1, -1] = 0.3
        recording = recordings.Recording(
            stamp_ns=STAMPS,
            offset=np.arange(0, SCANS * beams + 1, beams),
            points=points,
            hit=hit,
            T_base_sensor=T_base_sensor,
            sensor=np.zeros(SCANS, np.int32),
            T_odom_base=poses,
            beam_time=rng.uniform(0, 0.1, len(points)).astype(np.float32) if times else None,
        )
        p_static = rng.random(len(points)).astype(np.float32)
        log, out = tmp_path / f"log{dimension}", tmp_path / f"out{dimension}"
        recordings.write(recording, log)
        out.mkdir()
        _written(out, recording, poses, p_static, log)
        if with_models:
            (out / "mesh.glb").write_bytes(triangle_glb())
            (out / "objects/0007.glb").write_bytes(triangle_glb())
            place = {"T_map_object": np.eye(4).tolist(), "stamp_ns": int(STAMPS[1])}
            (out / "objects/0007.json").write_text(json.dumps(place))
        return out

    return made


@pytest.fixture
def beams_of():
    """Gives the beams of a result that `result_of` made."""

    def beams(out):
        recording = recordings.read(out.parent / out.name.replace("out", "log"))
        poses = poses_from_tum(out / "trajectory.tum", recording)
        return Beams(recording, np.load(out / "beams/p_static.npy"), poses, SlamOptions())

    return beams


@pytest.fixture
def opened():
    """Opens windows, which are closed after the test."""
    pytest.importorskip("viser", reason="the extra `viewer` is not installed")
    from stillmap.results.viewer.window import Window

    windows = []

    def window(*words):
        windows.append(Window(*words))
        return windows[-1]

    yield window
    for one in windows:
        one.close()


@pytest.fixture
def window(result_of, beams_of, opened):
    """One of a 3D result with surface and models."""
    out = result_of(3, with_models=True)
    return opened(Scene(out, "walk<b>.bag"), beams_of(out))


def _written(out, recording, poses, p_static, log):
    write_tum(out / "trajectory.tum", recording.stamp_ns, poses)
    write_labels(out / "beams", recording, p_static)
    if recording.dimension == 3:
        write_clouds(out, recording, poses, p_static)
    p_occupied = np.full((60, 80), np.nan, np.float32)
    p_occupied[10:50, 10:70] = 0.0
    p_occupied[10, 10:70] = 1.0
    parts = {"p_occupied": p_occupied, "origin": np.array([-4.0, -3.0, 0.0]), "resolution": 0.1}
    write_npz(out / "map.npz", {name: np.asarray(part) for name, part in parts.items()})
    (out / "objects").mkdir()
    track = {
        "stamp_ns": STAMPS[1:4].tolist(),
        "x": [0.0, 1.0, 2.0],
        "y": [0.0, 0.0, 1.0],
        "vx": [1.0, 1.0, 0.0],
        "vy": [0.0, 0.0, 1.0],
    }
    size = [0.8, 0.4]
    if recording.dimension == 3:
        track["z"], size = [0.9, 0.9, 0.9], [0.8, 0.4, 1.8]
    objects = [{"id": 7, "size": size, "beams": 1234, "p_dynamic": 0.98765, "track": track}]
    (out / "objects/objects.json").write_text(json.dumps(objects))
    (out / "report.html").write_text("<!doctype html>")
    record = {"input": {"path": str(log)}, "options": {"read": {}, "slam": {"deskew": True}}}
    (out / "run.json").write_text(json.dumps(record))
