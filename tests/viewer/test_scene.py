"""Reading a result folder for the viewer."""

import numpy as np
import pytest
from made_up_models import glb_of

from stillmap.core.arrays import sample_indices
from stillmap.core.errors import InputError
from stillmap.results.gltf import read_glb
from stillmap.results.viewer.nodes import default_view
from stillmap.results.viewer.scene import Scene


def test_map_image_has_the_orientation_of_the_map(result_of):
    plan = Scene(result_of(2)).map_image
    x0, y0, x1, y1 = plan.window
    height, width = plan.picture.shape[:2]
    edge = (x1 - x0) / width
    assert (y1 - y0) / height == pytest.approx(edge)
    assert 0.1 / edge == pytest.approx(round(0.1 / edge))  # cells are whole pixels
    row, column = np.nonzero((plan.picture[..., :3] == 0).all(axis=2))
    # the wall is at the lowest y of what is known: far below in the picture
    assert (y1 - edge * (row.max() + 1), y1 - edge * row.min()) == pytest.approx((-2.0, -1.9))
    assert (x0 + edge * column.min(), x0 + edge * (column.max() + 1)) == pytest.approx((-3.0, 3.0))


def test_3d_result(result_of):
    out = result_of(3, with_models=True)
    scene = Scene(out)
    assert not scene.is_2d
    p_static, hit = (np.load(out / f"beams/{name}.npy") for name in ("p_static", "hit"))
    counts = {
        "Static points": (hit & (p_static >= 0.5)).sum(),
        "Dynamic points": (hit & (p_static < 0.5)).sum(),
    }
    assert {name: len(one.points) for name, one in scene.clouds.items()} == counts
    assert scene.map_image.picture[0, 0, 3] == 0
    assert scene.surface == (out / "mesh.glb").read_bytes()
    assert [one.track.id for one in scene.models] == [7]
    z = scene.clouds["Static points"].points[:, 2]
    assert z.min() <= scene.ground <= np.median(z)


def test_models_move_along_their_tracks(result_of):
    scene = Scene(result_of(3, with_models=True))
    (model,) = scene.models
    own = model.pose_at(int(scene.stamp_ns[1]))  # where its file places it
    assert own[:3, 1].tolist() == [0.0, 0.0, 1.0]  # its y is up
    later = model.pose_at(int(scene.stamp_ns[3]))  # it has turned left by then
    assert later[:3, 3] == pytest.approx([2.0, 1.0, 0.0])
    assert later[:3, 0] == pytest.approx([0.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("mesh.glb", b"glTF", "no complete .glb"),
        ("objects/0007.json", b"{}", "damaged"),
        ("objects/0007.json", b'{"T_map_object": [[1]], "stamp_ns": 0}', "damaged"),
        ("objects/0007.json", None, "cannot be read"),
    ],
)
def test_unusable_model_is_noted(result_of, name, content, said):
    out = result_of(3, with_models=True)
    if content is None:
        (out / name).unlink()
    else:
        (out / name).write_bytes(content)
    scene = Scene(out)
    assert len(scene.notes) == 1
    assert said in scene.notes[0]
    assert (scene.surface is None) == (name == "mesh.glb")


@pytest.mark.parametrize("name", ["map.npz", "trajectory.tum", "objects/objects.json"])
def test_damaged_file_is_refused(result_of, name):
    out = result_of(2)
    (out / name).write_bytes(b"nonsense")
    with pytest.raises(InputError) as caught:
        Scene(out)
    assert str(out / name) in caught.value.where


def test_origin_is_shifted_far_from_zero(result_of):
    """A survey's coordinates have more digits than a float32."""
    out = result_of(3)
    text = (out / "trajectory.tum").read_text().split("\n")
    rows = [line.split() for line in text if line]
    moved = [[row[0], str(500_000.0 + float(row[1])), *row[2:]] for row in rows]
    (out / "trajectory.tum").write_text("".join(" ".join(row) + "\n" for row in moved))
    scene = Scene(out)
    assert (scene.origin == np.round(scene.origin)).all()
    assert np.abs(scene.poses[:, :3, 3] - scene.origin).max() < 10.0


def test_default_view_shows_the_whole_scene(result_of):
    flat, space = Scene(result_of(2)), Scene(result_of(3))
    above = default_view(flat)
    x0, y0, x1, y1 = flat.map_image.window
    center = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.0])
    assert above.look_at + flat.origin == pytest.approx(center)
    assert above.height >= y1 - y0
    down = (above.look_at - above.position) / np.linalg.norm(above.look_at - above.position)
    assert down[2] < -0.999
    assert down[1] > 0.0  # north is up
    slanted = default_view(space)
    away = slanted.position - slanted.look_at
    assert 0.3 < away[2] / np.linalg.norm(away) < 0.9


def test_sample_contains_every_lidar_ring():
    """At even steps 16 rings that come in turn would show one of them."""
    rings = np.bincount(sample_indices(160_000, 10_000) % 16, minlength=16)
    assert rings.min() > 400


def test_a_model_is_read_unchanged_and_a_damaged_or_large_one_refused(tmp_path, glb):
    path = tmp_path / "a.glb"
    path.write_bytes(glb)
    assert read_glb(path, len(glb)) == glb
    for data in (b"", glb_of({}, version=1), glb_of({}) + b"more", glb[:-1], glb + glb):
        path.write_bytes(data)
        with pytest.raises(InputError) as caught:
            read_glb(path, len(glb))
        assert caught.value.where == str(path)
