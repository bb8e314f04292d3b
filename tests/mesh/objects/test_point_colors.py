"""Colours of points, from start to end: what was seen of a small room with people in it."""

import dataclasses

import numpy as np
from model_readers import read_camera_simulation
from model_surface import compute_color_difference
from true_surfaces import project_to_static

import stillmap
from stillmap.core.camera import Images
from stillmap.io import stillmap_folder
from stillmap.io.trajectory import poses_from_tum
from stillmap.mesh.texture import GRAY
from stillmap.results.point_cloud import COLOURS, FIELDS
from stillmap.sim.camera import compute_static_color


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


def test_what_moves_has_colours_of_what_moves(room):
    """Of pictures that are red where something moves."""
    recording, truth = stillmap.read(room), read_camera_simulation(room).image_truth

    def paint(image):
        moves = truth.mask(image) > 0
        return np.stack([np.where(moves, 250, 10)] + 2 * [np.full(moves.shape, 30)], 2).astype("u1")

    images = recording.images
    painted = Images(images.stamp_ns, images.camera, images.cameras, paint)
    recording = dataclasses.replace(recording, images=painted)
    poses = poses_from_tum(room / "truth/trajectory.tum", recording)
    result = stillmap.build(recording, stillmap.Options(threads=1), poses=poses)
    colours = stillmap.build_models(result).point_colors
    use = recording.hit & (result.p_static < 0.5) & coloured(colours)
    use &= np.load(room / "truth/mover.npy") >= 0
    assert use.sum() > 100
    assert (colours[use, 0] > 130).mean() > 0.9


def test_the_files_say_the_same(room, result):
    hit, p_static, colours = beams_of(result)
    for part, of in (("static", p_static >= 0.5), ("dynamic", p_static < 0.5)):
        rows = rows_of(result / f"{part}.ply", FIELDS + COLOURS)
        np.testing.assert_array_equal(rgb(rows), colours[hit & of])
        assert coloured(rgb(rows)).any()
    assert len(colours) == stillmap_folder.read(room).n_beams
