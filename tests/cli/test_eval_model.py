"""`stillmap eval model` on made-up results of a small rig with a camera."""

import io
import json
import shutil
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from stillmap.cli.main import main
from stillmap.core import se2
from stillmap.core.errors import install_command
from stillmap.eval import mesh as mesh_module
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
        patch.setattr(mesh_module, "SAMPLES", 20_000)
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


@pytest.fixture(scope="module")
def scored(made, simulated) -> dict:
    """Its scores."""
    out = io.StringIO()
    with redirect_stdout(out):
        assert main(["eval", "model", str(made), str(simulated), "--json"]) == 0
    return json.loads(out.getvalue())


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


def _scores(capsys, *args: object) -> dict:
    assert main(["eval", "model", *(str(arg) for arg in args), "--json"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return json.loads(out)


@pytest.mark.slow
def test_raised_floor(made, simulated, scored, capsys) -> None:
    found = scored
    assert found["surface"]["mean"] == pytest.approx(UP, abs=1e-3)
    assert found["surface"]["area"] == pytest.approx(16.0, abs=1e-3)
    assert 0.0 < found["surface"]["complete"] < 0.3
    assert found["texture"]["colour_median"] < 2.5  # between texels of 6 cm
    assert found["texture"]["mover"] < 0.5
    assert found["texture"]["textured"] > 0.3
    # what the picture sees it paints, but for what people stand before
    assert found["texture"]["covered"] > 0.5
    assert _scores(capsys, made, simulated / "tilting") == found


def test_person_modelled_as_box(scored) -> None:
    movers = scored["movers"]
    assert (movers["tracked"], movers["modelled"]) == (1, 1.0)
    (one,) = movers["models"]
    assert (one["id"], one["kind"]) == (3, "person")
    assert 0.01 < one["accuracy"] < 0.12
    assert 0.01 < one["completeness"] < 0.12
    assert one["background"] is None


def test_within_limits_beam_length(made, simulated, scored, capsys) -> None:
    everything = scored["surface"]
    near = _scores(capsys, made, simulated, "--within", 3)["surface"]
    assert near["places"] < everything["places"]
    assert near["complete"] > everything["complete"]


def test_text(made, simulated, capsys) -> None:
    assert main(["eval", "model", str(made), str(simulated)]) == 0
    text = capsys.readouterr().out
    assert "off truth    mean 2.9" in text
    assert "textured -, background -" in text
    assert "1 tracked, 100.00 % with a model; of " in text


def test_missing_parts_are_not_scored(result, simulated, capsys) -> None:
    (result / "mesh_faces.npz").unlink()
    (result / "tilting/objects/objects.json").unlink()
    assert set(_scores(capsys, result, simulated)) == {"alignment", "surface"}


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("mesh.glb", "is damaged"),
        ("mesh_faces.npz", "is damaged"),
        ("tilting/objects/objects.json", "is not JSON"),
        ("tilting/objects/0003.json", "is not JSON"),
        ("tilting/objects/0003.glb", "is damaged"),
    ],
)
def test_damaged_files_are_named(name: str, what: str, result, simulated, capsys) -> None:
    (result / name).write_bytes(b"nonsense")
    assert main(["eval", "model", str(result), str(simulated)]) == 2
    err = capsys.readouterr().err
    assert what in err
    assert name in err


def test_result_without_mesh_is_refused(result, simulated, capsys) -> None:
    (result / "mesh.glb").unlink()
    assert main(["eval", "model", str(result), str(simulated)]) == 2
    err = capsys.readouterr().err
    assert f"{result}: holds no model" in err
    assert install_command("mesh") in err


def test_result_of_another_recording_is_refused(result, simulated, tmp_path, capsys) -> None:
    other = shutil.copytree(simulated, tmp_path / "other")
    stamps = np.load(other / "tilting/stamp_ns.npy")
    np.save(other / "tilting/stamp_ns.npy", stamps + 10**12)
    assert main(["eval", "model", str(result), str(other)]) == 2
    err = capsys.readouterr().err
    assert f"{result}: is not of the recording in {other / 'tilting'}" in err
    assert "--max-dt" not in err


@pytest.mark.parametrize("missing", [0, 1])
def test_missing_folders_are_named(missing, result, simulated, tmp_path, capsys) -> None:
    words = [str(result), str(simulated)]
    words[missing] = str(tmp_path / "nothere")
    assert main(["eval", "model", *words]) == 2
    assert f"{tmp_path / 'nothere'}: does not exist" in capsys.readouterr().err


def test_records_of_other_images_are_refused(result, simulated, capsys) -> None:
    with np.load(result / "mesh_faces.npz") as archive:
        arrays = dict(archive)
    arrays["T_camera_map"] = arrays["T_camera_map"][:1]
    np.savez(result / "mesh_faces.npz", **arrays)
    assert main(["eval", "model", str(result), str(simulated)]) == 2
    assert "has 1 images" in capsys.readouterr().err


def test_simulation_without_cameras_is_refused(result, simulated, capsys) -> None:
    assert main(["eval", "model", str(result), str(simulated / "horizontal")]) == 2
    assert "no truth about images" in capsys.readouterr().err
