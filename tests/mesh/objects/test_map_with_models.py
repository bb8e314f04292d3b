"""`stillmap map` of small simulated recordings with pictures: models from start to end."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import trimesh

from stillmap.cli.main import main
from stillmap.core import se2
from stillmap.core.camera import project
from stillmap.io import stillmap_folder
from stillmap.sim.truth import load_image_truth

QUICK = ("--quiet", "--threads", "1", "--set", "em.max_iterations=1")


def record_of(out):
    return json.loads((out / "run.json").read_text())["models"]


def spoiled(out, recording):
    """The share of the painted area whose middles are, in the picture that paints them, on
    something that moves."""
    truth, camera = load_image_truth(recording), stillmap_folder.read(recording).images.cameras[0]
    faces = np.load(out / "mesh_faces.npz")
    corners = faces["vertices"][faces["faces"]]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    bad = np.zeros(len(area), bool)
    for image in np.unique(faces["image"][faces["image"] >= 0]):
        mine, T = faces["image"] == image, faces["T_camera_map"][image]
        uv, ok = project(camera, corners[mine].mean(axis=1) @ T[:3, :3].T + T[:3, 3])
        assert ok.all()
        u, v = np.floor(uv).astype(int).T
        assert ((u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)).all()
        bad[mine] = truth.mask(image)[v, u] > 0
    return area[bad].sum() / area[faces["image"] >= 0].sum()


def test_the_model_opens_and_is_textured(result):
    scene = trimesh.load(result / "mesh.glb")
    assert set(scene.geometry) == {"page0", "grey"}
    page = scene.geometry["page0"]
    texture = np.asarray(page.visual.material.baseColorTexture.convert("RGB"))
    assert list(texture.shape[:2]) == record_of(result)["pages"][0]
    assert texture.std() > 10.0
    assert np.ptp(page.visual.uv, axis=0).min() > 0.5
    # y is up: a room of 8 x 6 m, the robot is on its floor
    low, high = scene.bounds
    assert 7.0 < high[0] - low[0] < 9.0
    assert 5.0 < high[2] - low[2] < 7.0
    assert abs(low[1]) < 0.2


def test_what_is_told_of_faces_fits_the_model(room, result):
    faces, record = np.load(result / "mesh_faces.npz"), record_of(result)
    F, n = len(faces["faces"]), len(stillmap_folder.read(room).images)
    assert record["faces"] == F == len(faces["image"]) == len(faces["p_static"])
    assert faces["faces"].max() < len(faces["vertices"])
    painted = faces["image"] >= 0
    assert (faces["p_static"][painted] >= 0.6).all()
    assert (faces["p_static"][~painted] == 0.0).all()
    shapes = trimesh.load(result / "mesh.glb").geometry
    assert len(shapes["page0"].faces) == painted.sum()
    assert len(shapes["grey"].faces) == (~painted).sum()
    assert record["pictures"] == {
        "used": len(np.unique(faces["image"][painted])),
        "usable": n,
        "left_out": {},
        "unread": [],
    }
    assert 0 < record["area_painted"] < record["area_seen"] < record["area"]
    # the map's frame is that of the poses given
    truth = load_image_truth(room).T_world_camera
    np.testing.assert_allclose(se2.inverse(faces["T_camera_map"]), truth, atol=0.02)


def test_movers_have_models_where_they_were(result):
    objects = {one["id"]: one for one in json.loads((result / "objects/objects.json").read_text())}
    models = sorted(result.glob("objects/????.glb"))
    assert len(models) == record_of(result)["objects"]["modelled"] > 0
    assert record_of(result)["objects"]["found"] == len(objects)
    for path in models:
        one = objects[int(path.stem)]
        about = json.loads(path.with_suffix(".json").read_text())
        track, stamp = one["track"], about["stamp_ns"]
        assert about["first_stamp_ns"] <= stamp <= about["last_stamp_ns"]
        assert not about["rigid"]
        at = [np.interp(stamp, track["stamp_ns"], track[axis]) for axis in "xy"]
        np.testing.assert_allclose(np.array(about["T_map_object"])[:2, 3], at, atol=0.1)
        low, high = trimesh.load(path).bounds  # about its middle, on the ground
        assert (np.abs([low[[0, 2]], high[[0, 2]]]) < 1.0).all()
        assert -0.1 < low[1] < high[1] < 2.2
        faces = np.load(path.with_name(f"{path.stem}_faces.npz"))
        assert len(faces["image"]) == sum(
            len(shape.faces) for shape in trimesh.load(path).geometry.values()
        )
        assert faces["T_camera_object"].shape[1:] == (4, 4)


def test_without_pictures_the_surface_is_grey_and_lit(room, result, mapped, tmp_path):
    bare = tmp_path / "bare"
    stillmap_folder.write(dataclasses.replace(stillmap_folder.read(room), images=None), bare)
    out = mapped("bare", "--mesh", source=bare)
    scene = trimesh.load(out / "mesh.glb")
    assert set(scene.geometry) == {"grey"}
    assert b"KHR_materials_unlit" not in (out / "mesh.glb").read_bytes()
    assert b"KHR_materials_unlit" in (result / "mesh.glb").read_bytes()
    record = record_of(out)
    assert record["area_painted"] == record["area_seen"] == record["pictures"]["usable"] == 0
    assert (np.load(out / "mesh_faces.npz")["image"] == -1).all()
    assert record["area"] == pytest.approx(record_of(result)["area"], rel=0.01)


@pytest.mark.slow
def test_damaged_pictures_are_told_of_and_others_paint_in_their_place(
    room, result, mapped, tmp_path
):
    bad, n = tmp_path / "bad", len(stillmap_folder.read(room).images)
    shutil.copytree(room, bad)
    pictures = sorted((bad / "images").iterdir())
    pictures[1].write_bytes(pictures[1].read_bytes()[:200])
    pictures[4].write_bytes(b"")
    out = mapped("bad", source=bad)
    record = json.loads((out / "run.json").read_text())
    told = record["models"]["pictures"]
    assert told["usable"] == n - 2
    assert told["left_out"] == {"images that cannot be read": 2}
    first, second = told["unread"]
    assert pictures[1].name in first
    assert pictures[4].name in second
    assert f"images that are not used: 2, {first}" in record["warnings"]
    # what paints is what was left; but for what only those two saw, all is painted as before
    image = np.load(out / "mesh_faces.npz")["image"]
    assert not np.isin(image, (1, 4)).any()
    assert np.isin(np.load(result / "mesh_faces.npz")["image"], (1, 4)).any()
    assert record["models"]["area_painted"] > 0.9 * record_of(result)["area_painted"]
    # and nothing that counts as painted is grey
    page = trimesh.load(out / "mesh.glb").geometry["page0"]
    colours = trimesh.visual.color.uv_to_color(
        page.visual.uv, page.visual.material.baseColorTexture
    )
    assert (colours[:, :3] == 128).all(axis=1).mean() < 0.01


def test_without_pictures_there_are_models_by_request_alone(room, tmp_path, capsys):
    bare = tmp_path / "bare"
    stillmap_folder.write(dataclasses.replace(stillmap_folder.read(room), images=None), bare)
    words = ("map", bare, "-o", tmp_path / "out", "--poses", room / "truth/trajectory.tum")
    words += ("--threads", "1", "--set", "em.max_iterations=1")
    assert main([*map(str, words)]) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "--mesh" in line]
    assert told == [
        "stillmap: no surface model: the recording has no pictures, --mesh makes a grey one"
    ]
    assert not list(tmp_path.glob("out/**/*.glb"))
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert "models" not in record
    assert not any("models" in one for one in record["warnings"])


@pytest.mark.slow
def test_a_laser_that_tilts_and_pictures_beside_it(rig, tmp_path):
    out = tmp_path / "out"
    words = ("map", rig / "horizontal", "--tilting", rig / "tilting", "-o", out, *QUICK)
    assert main([str(word) for word in words]) == 0
    record = record_of(out)
    assert record["pictures"]["used"] > 5
    assert record["area_painted"] > 0.5 * record["area_seen"] > 5.0
    assert spoiled(out, rig / "tilting") < 0.03
    assert "page0" in trimesh.load(out / "mesh.glb").geometry
