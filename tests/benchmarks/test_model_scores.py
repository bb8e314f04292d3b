"""Scores of a made-up model of a small rig with a camera."""

import json
import math
import shutil
from pathlib import Path

import model_surface
import numpy as np
import pytest
from model_scores import score_model
from numpy.typing import NDArray
from PIL import Image

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.io import read
from stillmap.io.trajectory import write_tum
from stillmap.sim import (
    compute_static_color,
    load_image_truth,
    load_truth,
    scene_by_name,
    simulate_rig,
    write_rig,
)

Float = NDArray[np.float64]

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("skimage")

UP = 0.03  # m, by which the made-up floor is too high
SIZE = 64  # texels


@pytest.fixture(scope="module", autouse=True)
def _fewer_points():
    """A floor of a few square metres needs no more."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_surface, "SAMPLES", 20_000)
        yield


@pytest.fixture(scope="module")
def simulated(tmp_path_factory) -> Path:
    changes = {
        "rig": {"tilts": True},
        "robot": {"scans": 60, "scan_rate": 37.5},
        "crowd": {"people": 40},
        "camera": {"enabled": True, "width": 96, "height": 72},
    }
    path = tmp_path_factory.mktemp("model") / "sim"
    write_rig(simulate_rig(scene_by_name("hall", changes), 2), path)
    return path


@pytest.fixture(scope="module")
def made(simulated, tmp_path_factory) -> Path:
    """Four metres of the floor ahead of the robot, in true colours; one person as a box."""
    out = tmp_path_factory.mktemp("made") / "result"
    (out / "tilting/objects").mkdir(parents=True)
    recording, truth = read(simulated / "tilting"), load_truth(simulated / "tilting")
    T_map_world = se2.inverse(truth.T_world_base[0])
    write_tum(out / "trajectory.tum", recording.stamp_ns, T_map_world @ truth.T_world_base)
    seed = load_image_truth(simulated / "tilting").colour_seed
    _write_floor(out / "mesh.glb", np.linalg.inv(T_map_world), seed)
    assert recording.images is not None
    T_base_camera = recording.images.cameras[0].T_base_camera
    T_world_camera = load_image_truth(simulated / "tilting").T_world_camera
    vertices, faces, _ = _floor()
    np.savez(
        out / "mesh_faces.npz",
        vertices=vertices,
        faces=faces,
        image=np.zeros(2, np.int32),
        T_camera_map=se2.inverse(T_map_world @ T_world_camera),
    )
    assert T_base_camera is not None
    _write_person(out / "tilting/objects", simulated, T_map_world)
    return out


@pytest.fixture
def result(made, tmp_path) -> Path:
    """The same, to be changed."""
    return Path(shutil.copytree(made, tmp_path / "result"))


def _floor() -> tuple[Float, NDArray[np.int32], Float]:
    """Corners in the map frame, faces, and where the corners are in the texture."""
    uv = np.array([(0.0, 0.0), (1, 0), (1, 1), (0, 1)])
    vertices = np.column_stack([2.0 + 4.0 * uv[:, 0], 4.0 * uv[:, 1] - 2.0, np.full(4, UP)])
    return vertices, np.array([(0, 1, 2), (0, 2, 3)], np.int32), uv


def _write_floor(path: Path, T_world_map: Float, seed: int) -> None:
    vertices, faces, uv = _floor()
    at = (np.arange(SIZE) + 0.5) / SIZE
    u, v = np.meshgrid(at, at[::-1])  # the first row is the upper one
    places = np.stack([2.0 + 4.0 * u, 4.0 * v - 2.0, np.zeros_like(u)], axis=-1).reshape(-1, 3)
    world = places @ T_world_map[:3, :3].T + T_world_map[:3, 3]
    picture = Image.fromarray(compute_static_color(world, seed).reshape(SIZE, SIZE, 3))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    _export(vertices, faces, path, visual)


def _export(vertices: Float, faces: NDArray[np.int32], path: Path, visual: object = None) -> None:
    x, y, z = vertices.T
    mesh = trimesh.Trimesh(np.stack([x, z, -y], axis=1), faces, visual=visual, process=False)
    mesh.export(path)


def _write_person(folder: Path, simulated: Path, T_map_world: Float) -> None:
    """The person who is seen most often, as a box, and a track of nobody."""
    truth, recording = load_truth(simulated / "tilting"), read(simulated / "tilting")
    who = np.bincount(truth.mover[truth.mover >= 0]).argmax()
    xy = truth.movers[:, who, :2] @ T_map_world[:2, :2].T + T_map_world[:2, 3]
    stamps = recording.stamp_ns.tolist()
    tracks = [
        {"id": id, "track": {"stamp_ns": stamps, "x": (x + far).tolist(), "y": y.tolist()}}
        for id, far, (x, y) in ((3, 0.1, xy.T), (4, 500.0, xy.T))
    ]
    (folder / "objects.json").write_text(json.dumps(tracks), encoding="utf-8")
    box = trimesh.creation.box((0.3, 0.5, 1.7))
    box.apply_translation((0, 0, 0.85))
    _export(np.asarray(box.vertices), np.asarray(box.faces, np.int32), folder / "0003.glb")
    x, y, yaw = truth.movers[30, who]
    T_map_object = T_map_world @ np.array(
        [
            [np.cos(yaw), -np.sin(yaw), 0, x],
            [np.sin(yaw), np.cos(yaw), 0, y],
            [0, 0, 1, 0],
            [0, 0, 0, 1],
        ]
    )
    about = {"T_map_object": T_map_object.tolist(), "stamp_ns": stamps[30]}
    (folder / "0003.json").write_text(json.dumps(about), encoding="utf-8")


@pytest.fixture(scope="module")
def scored(made, simulated) -> dict:
    return score_model(made, simulated, math.inf)


def test_person_modelled_as_box(scored) -> None:
    movers = scored["movers"]
    assert (movers["tracked"], movers["modelled"]) == (1, 1.0)
    (one,) = movers["models"]
    assert (one["id"], one["kind"]) == (3, "person")
    assert 0.01 < one["accuracy"] < 0.12
    assert 0.01 < one["completeness"] < 0.12
    assert one["background"] is None


@pytest.mark.slow
def test_raised_floor(scored) -> None:
    surface, texture = scored["surface"], scored["texture"]
    assert surface["mean"] == pytest.approx(UP, abs=1e-3)
    assert surface["area"] == pytest.approx(16.0, abs=1e-3)
    assert 0.0 < surface["complete"] < 0.3
    assert texture["colour_median"] < 2.5  # between texels of 6 cm
    assert texture["mover"] < 0.5
    assert texture["textured"] > 0.3
    # what the picture sees it paints, but for what people stand before
    assert texture["covered"] > 0.5


def test_within_limits_beam_length(made, simulated, scored) -> None:
    near = score_model(made, simulated, 3.0)["surface"]
    assert near["places"] < scored["surface"]["places"]
    assert near["complete"] > scored["surface"]["complete"]


def test_missing_parts_are_not_scored(result, simulated) -> None:
    (result / "mesh_faces.npz").unlink()
    (result / "tilting/objects/objects.json").unlink()
    assert set(score_model(result, simulated, math.inf)) == {"alignment", "surface"}


def test_damaged_model_is_named(result, simulated) -> None:
    (result / "mesh.glb").write_bytes(b"nonsense")
    with pytest.raises(InputError, match=r"mesh\.glb: is damaged"):
        score_model(result, simulated, math.inf)
