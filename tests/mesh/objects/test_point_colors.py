"""Colours of points, from start to end: what was seen of a small room with people in it."""

import dataclasses
import functools
import json
from collections.abc import Callable
from unittest import mock

import numpy as np
import pytest
from model_readers import read_camera_simulation
from model_surface import compute_color_difference
from true_surfaces import project_to_static

import stillmap
from stillmap.cli.main import main
from stillmap.core.camera import Images
from stillmap.io import stillmap_folder
from stillmap.io.trajectory import poses_from_tum
from stillmap.mesh import build
from stillmap.mesh.place import assign_views
from stillmap.mesh.texture.atlas import GRAY
from stillmap.results import point_cloud
from stillmap.results.points import COLOURS, FIELDS
from stillmap.sim import load_image_truth
from stillmap.sim.appearance import compute_static_color


def beams_of(out, name="beams"):
    """Hits, P(static), colours."""
    return [np.load(out / name / f"{what}.npy") for what in ("hit", "p_static", "colour")]


def rows_of(path, fields):
    head, _, data = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("prop")]
    assert names == [name for name, _ in fields]
    return np.frombuffer(data, fields)


def rgb(rows):
    return np.stack([rows[name] for name, _ in COLOURS], axis=1)


def coloured(colours):
    return (colours != GRAY).any(axis=1)


def test_colours_of_what_stands_still_are_the_true_ones(room, result):
    hit, p_static, colours = beams_of(result)
    seen, still = read_camera_simulation(room), hit & (p_static >= 0.5)
    has = coloured(colours)
    assert not has[~hit].any()
    assert 0.1 < has[still].mean() < 0.5  # the lidar looks round about, the camera does not
    use = np.flatnonzero(still & has & seen.truth.static())
    _, places = project_to_static(seen.image_truth.standing, seen.end_points[use])
    true = compute_static_color(places, seen.image_truth.colour_seed)
    difference = compute_color_difference(colours[use], true)
    assert np.median(difference) < 5.0
    mixed = compute_color_difference(colours[use], np.roll(true, len(true) // 3, axis=0))
    assert np.median(mixed) > 3.0 * np.median(difference)


@pytest.fixture(scope="module")
def told(room) -> Callable[..., tuple[stillmap.Result, np.ndarray]]:
    """The room with pictures of what is to be seen in place of colours: red is what moves; gives
    which beams have the colour of something that moves, and which any."""
    recording, truth = stillmap.read(room), load_image_truth(room)
    poses = poses_from_tum(room / "truth/trajectory.tum", recording)

    def seen(image: int) -> np.ndarray:
        moves = truth.mask(image) > 0
        return np.stack([np.where(moves, 250, 10)] + 2 * [np.full(moves.shape, 30)], 2).astype("u1")

    images = recording.images
    of_masks = Images(images.stamp_ns, images.camera, images.cameras, seen)
    recording = dataclasses.replace(recording, images=of_masks)
    found = stillmap.build(recording, stillmap.Options(threads=1), poses=poses)

    def tell(use_occlusion: bool):
        with mock.patch.object(
            build, "assign_views", functools.partial(assign_views, use_occlusion=use_occlusion)
        ):
            return found, stillmap.build_models(found).point_colors.colors

    return tell


def test_nobody_colours_what_stands_still_unless_beams_are_not_believed(told):
    shares = []
    for believe in (True, False):
        found, colours = told(believe)
        use = found.recording.hit & (found.p_static >= 0.5) & coloured(colours)
        shares.append((colours[use, 0] > 130).mean())
    assert shares[0] < 0.02
    assert shares[1] > 0.06


def test_what_moves_has_colours_of_what_moves(told, room):
    found, colours = told(True)
    use = found.recording.hit & (found.p_static < 0.5) & coloured(colours)
    use &= np.load(room / "truth/mover.npy") >= 0
    assert use.sum() > 100
    assert (colours[use, 0] > 130).mean() > 0.9


def test_the_files_say_the_same(room, result):
    hit, p_static, colours = beams_of(result)
    counts = json.loads((result / "run.json").read_text())["models"]["points"]
    for part, of in (("static", p_static >= 0.5), ("dynamic", p_static < 0.5)):
        rows = rows_of(result / f"{part}.ply", FIELDS + COLOURS)
        np.testing.assert_array_equal(rgb(rows), colours[hit & of])
        assert counts[part] == len(rows)
        assert counts[f"{part}_coloured"] == coloured(rgb(rows)).sum() > 0
    assert len(colours) == stillmap_folder.read(room).n_beams


@pytest.mark.parametrize("only", [None, "static", "dynamic"])
def test_a_cloud_in_another_form_has_them_too(result, tmp_path, only):
    hit, p_static, colours = beams_of(result)
    part = {None: hit, "static": hit & (p_static >= 0.5), "dynamic": hit & (p_static < 0.5)}[only]
    words = ["convert", result, "-o", tmp_path / "a.ply", "--quiet"]
    words += ["--only", only] if only else []
    assert main([str(word) for word in words]) == 0
    np.testing.assert_array_equal(rgb(rows_of(tmp_path / "a.ply", FIELDS + COLOURS)), colours[part])


def test_other_colours_than_beams_are_refused(mapped, tmp_path, capsys):
    out = mapped("damaged")
    _, _, colours = beams_of(out)
    for wrong in (colours[:-1], colours.astype(np.uint16)):
        np.save(out / "beams/colour.npy", wrong)
        assert main(["convert", str(out), "-o", str(tmp_path / "a.ply")]) == 2
        assert "colour.npy: " in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_threads_and_another_time_change_no_bit(result, mapped):
    again = mapped("again-points", "--threads", "2")
    for name in ("static.ply", "dynamic.ply", "beams/colour.npy"):
        assert (again / name).read_bytes() == (result / name).read_bytes()


@pytest.mark.slow
def test_a_rig_has_them_beside_the_beams_of_the_laser_that_tilts(rig, mapped, tmp_path):
    """Of the flat one nobody asks for a cloud."""
    poses = ("--poses", rig / "horizontal/truth/trajectory.tum", "--tilting", rig / "tilting")
    out = mapped("rig-points", *poses, source=rig / "horizontal")
    assert not (out / "beams/colour.npy").exists()
    hit, p_static, colours = beams_of(out, "tilting/beams")
    static = rows_of(out / "static.ply", FIELDS + COLOURS)
    np.testing.assert_array_equal(rgb(static), colours[hit & (p_static >= 0.5)])
    assert coloured(rgb(static)).mean() > 0.2
    assert point_cloud.cloud_from_folder(out).has_colors
    assert main(["convert", str(out), "-o", str(tmp_path / "a.xyz"), "--quiet"]) == 0
    found = np.loadtxt(tmp_path / "a.xyz", skiprows=1)
    np.testing.assert_array_equal(found[: len(static), 4:], rgb(static))
