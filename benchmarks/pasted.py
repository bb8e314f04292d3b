"""People pasted into the depth and colours of a room that was recorded without any.

python benchmarks/pasted.py ../shared/data/rgbd/kitchenette OUT

OUT becomes an RGB-D folder, with `truth.npz` in it: `depth` and `colour` (T, height, width), what
of each picture is a person. Each is an upright ellipsoid with a pattern, who crosses the view
within six seconds; for the next six nobody is there.
"""

import argparse
import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import minimum_filter

import stillmap
from stillmap.core import camera as camera_module
from stillmap.core.camera import Camera
from stillmap.io import rgbd
from stillmap.io.cameras import read_image
from stillmap.io.rgbd import list_frames
from stillmap.prepare.options import ReadOptions

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

_HALF = np.array([0.25, 0.25, 0.8])  # m, along the axes
_CROSSES, _SPEED, _AHEAD, _LOW = 6.0, 0.6, 1.5, -0.6  # s, m/s, m, m below the camera
_NOISE = 0.002  # m at a metre, growing with the square of the depth
_STRIPE, _FIELDS = 0.12, 8  # m upwards, and fields around, of the pattern
_COLOURS = np.array([[230, 190, 20], [30, 60, 200]])


def paste(source: Path, out: Path) -> Path:
    """Write the folder.

    Args:
        source: frames of 7-Scenes, with poses of all.
        out: it must not be there.

    Returns:
        `out`.
    """
    room = stillmap.read(source, options=ReadOptions(depth_step=1))
    assert room.T_recorded_base is not None
    assert room.images is not None
    colour = room.images.cameras[0]
    depth = rgbd.read_depth_camera(list_frames(source), {}, [])
    out.mkdir(parents=True)
    shutil.copy(source / "camera-intrinsics.txt", out)
    found: tuple[list[Mask], list[Mask]] = ([], [])
    for number, file in enumerate(sorted(source.glob("frame-*.depth.png"))):
        name = file.name.partition(".")[0]
        shutil.copy(source / f"{name}.pose.txt", out)
        millimetres, picture = read_image(file), room.images.read(number)
        at, T = _centre(room, number), room.T_recorded_base[number]
        beams = room.beams_of(number)
        scene = room.points[beams][room.hit[beams]]
        seen = [_seen(camera, T, at, scene) for camera in (depth, colour)]
        for one, kept in zip(seen, found, strict=True):
            kept.append(one[2])
        z, _, its = seen[0]
        noise = np.random.default_rng(number).normal(0.0, _NOISE, int(its.sum()))
        millimetres[its] = np.round(1e3 * (z[its] + noise * z[its] ** 2))
        _, pattern, its = seen[1]
        picture[its] = pattern[its]
        Image.fromarray(millimetres).save(out / f"{name}.depth.png", compress_level=1)
        Image.fromarray(picture).save(out / f"{name}.color.png", compress_level=1)
    np.savez_compressed(out / "truth.npz", depth=np.array(found[0]), colour=np.array(found[1]))
    return out


def _centre(room: stillmap.Recording, number: int) -> Float | None:
    """(3,) where the person is, in the level world; None: nobody is there."""
    seconds = 1e-9 * (room.stamp_ns - room.stamp_ns[0])
    spell, since = divmod(seconds[number], _CROSSES)
    if spell % 2:
        return None
    middle = int(np.searchsorted(seconds, (spell + 0.5) * _CROSSES))
    assert room.T_recorded_base is not None
    T = room.T_recorded_base[min(middle, room.n_scans - 1)]
    ahead = T[:2, 0] / np.linalg.norm(T[:2, 0])
    aside = _SPEED * (0.5 * _CROSSES - since) * np.array([-ahead[1], ahead[0]])
    return np.append(T[:2, 3] + _AHEAD * ahead + aside, T[2, 3] + _LOW)


def _seen(
    camera: Camera, T_map_base: Float, centre: Float | None, scene: NDArray[np.float32]
) -> tuple[Float, NDArray[np.uint8], Mask]:
    """(h, w) depth of the person, (h, w, 3) colours, and (h, w) where nothing is before him.

    Args:
        camera: it sits on the base.
        T_map_base: (4, 4).
        centre: (3,) of the person; None: nobody.
        scene: (n, 3) what else is seen, in the base's frame.
    """
    h, w = camera.height, camera.width
    nobody = np.full((h, w), np.inf), np.zeros((h, w, 3), np.uint8), np.zeros((h, w), bool)
    if centre is None:
        return nobody
    assert camera.T_base_camera is not None
    T = T_map_base @ camera.T_base_camera
    columns, rows = np.meshgrid(np.arange(w), np.arange(h))
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    rays = camera_module.unproject(camera, pixels) @ T[:3, :3].T
    # the ellipsoid is a ball of radius 1 where lengths are in its half axes
    ray, origin = rays / _HALF, (T[:3, 3] - centre) / _HALF
    a, b, c = np.sum(ray * ray, axis=1), ray @ origin, origin @ origin - 1.0
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    z = np.where((b * b > a * c) & (-b > root), (-b - root) / a, np.inf)
    on = np.where(
        np.isfinite(z)[:, None], origin + np.where(np.isfinite(z), z, 0.0)[:, None] * ray, 0
    )
    around = np.floor(np.arctan2(on[:, 1], on[:, 0]) / (2.0 * np.pi) * _FIELDS)
    field = (around + np.floor(on[:, 2] * _HALF[2] / _STRIPE)).astype(np.intp) % 2
    before = z.reshape(h, w) < _depth_of(camera, scene)
    return z.reshape(h, w), _COLOURS[field].astype(np.uint8).reshape(h, w, 3), before


def _depth_of(camera: Camera, scene: NDArray[np.float32]) -> Float:
    """(h, w) how far away the nearest of points (n, 3) on the base is, inf where there is none."""
    assert camera.T_base_camera is not None
    R, t = camera.T_base_camera[:3, :3], camera.T_base_camera[:3, 3]
    points = (scene.astype(np.float64) - t) @ R
    uv, ok = camera_module.project(camera, points)
    ok &= camera_module.is_in_image(camera, uv)
    column, row = np.round(uv[ok]).astype(np.intp).T
    out = np.full((camera.height, camera.width), np.inf)
    np.minimum.at(out, (row, column), points[ok, 2])
    # between points of another camera there are pixels without one
    return np.where(np.isfinite(out), out, minimum_filter(out, 3))


def main() -> None:
    p = argparse.ArgumentParser(description="People pasted into a recorded room.")
    p.add_argument("source", type=Path)
    p.add_argument("out", type=Path)
    args = p.parse_args()
    print(paste(args.source, args.out))


if __name__ == "__main__":
    main()
