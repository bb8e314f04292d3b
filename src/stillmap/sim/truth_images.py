"""Truth about images and surfaces of a simulation, as files beside the truth about its beams."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import open_npy, write_npy, write_npz
from stillmap.core.camera import Images
from stillmap.core.errors import InputError
from stillmap.io.images import read_image, write_png
from stillmap.sim.camera import CameraSimulator
from stillmap.sim.geometry import Faces, Ground, Solids
from stillmap.sim.recorder import World
from stillmap.sim.truth_surfaces import MovingSurfaces, StaticSurfaces

Float = NDArray[np.float64]

_IMAGES = "images"
_STANDING, _MOVING, _POSE = "standing.npz", "moving.npz", "moving_pose.npy"
_CAMERAS = "T_world_camera.npy"
_MAX_DISTANCE = 65.535  # m, of a 16-bit image in millimetres


@dataclass(frozen=True, eq=False)
class ImageTruth:
    """Truth about N images and the surfaces that they show.

    Attributes:
        colour_seed: of `appearance.compute_static_color`.
        standing, moving: the true surfaces.
        T_world_camera: (N, 4, 4) pose of each image.
        mask: of an image, (h, w) uint16; 0: static, k + 1: mover k, 65535: nothing.
        distance: of an image, (h, w) float32 metres along each pixel's ray; inf: nothing, or too
            far.
    """

    colour_seed: int
    standing: StaticSurfaces
    moving: MovingSurfaces
    T_world_camera: Float
    mask: Callable[[int], NDArray[np.uint16]]
    distance: Callable[[int], NDArray[np.float32]]


def make_image_truth(world: World, photographs: CameraSimulator) -> ImageTruth:
    """The truth about the images of a world."""
    return ImageTruth(
        photographs.colour_seed,
        *collect_surfaces(world),
        photographs.T_world_camera,
        lambda image: photographs.render(image).mask,
        lambda image: photographs.render(image).distance,
    )


def collect_surfaces(world: World) -> tuple[StaticSurfaces, MovingSurfaces]:
    """The surfaces of a world; movers that never moved are static."""
    poses = []
    for scan in range(len(world.ridden)):
        moment = world.moment(np.array([scan]), np.zeros(1))
        carried = world.carried.at(moment, scan)
        poses.append(carried.pose[0])
    carried = carried._replace(pose=np.stack(poses))
    moves = carried.mover >= 0
    never = carried._replace(pose=carried.pose[:1]).select(~moves)
    standing = world.static._replace(solids=world.static.solids.concatenate(never))
    return standing, MovingSurfaces(world.happening.exact_ns, carried.select(moves))


def write_image_truth(truth: ImageTruth, folder: Path) -> None:
    """Write all but masks and distances into an existing folder."""
    faces, solids, ground, ceiling = truth.standing
    standing: dict[str, NDArray[Any]] = {
        "faces_ends": faces.ends,
        "faces_z": faces.z,
        "faces_glass": faces.is_glass,
        **{f"solids_{name}": value for name, value in solids._asdict().items()},
        **{f"ground_{name}": np.asarray(value) for name, value in ground._asdict().items()},
        "ceiling": np.array(np.nan if ceiling is None else ceiling),
        "colour_seed": np.array(truth.colour_seed),
    }
    write_npz(folder / _STANDING, standing)
    moving = truth.moving.solids._asdict()
    write_npy(folder / _POSE, moving.pop("pose"))
    write_npz(folder / _MOVING, {"stamp_ns": truth.moving.stamp_ns, **moving})
    np.save(folder / _CAMERAS, truth.T_world_camera)


def write_truth_on_read(photographs: CameraSimulator, folder: Path) -> Images:
    """The images; reading one writes its truth, so that each is rendered once only."""
    inside = folder / _IMAGES
    inside.mkdir()

    def load(image: int) -> NDArray[np.uint8]:
        one = photographs.render(image)
        write_png(one.mask, inside / f"{image:06d}.png")
        near = np.where(one.distance < _MAX_DISTANCE, one.distance, 0.0)
        write_png(np.rint(1e3 * near).astype(np.uint16), inside / _distance(image))
        return one.color

    images = photographs.images
    return Images(images.stamp_ns, images.camera, images.cameras, load)


def load_image_truth(path: str | Path) -> ImageTruth:
    """Load the truth about images, given the folder of a simulation or the `truth` inside.

    Raises:
        InputError: there is none, or it is damaged.
    """
    folder = Path(path)
    if (folder / "truth").is_dir():
        folder = folder / "truth"
    if not (folder / _STANDING).is_file():
        hint = "a folder that 'stillmap simulate ... --camera' wrote"
        raise InputError("holds no truth about images", where=str(path), hint=hint)
    try:
        of, moves = _arrays(folder / _STANDING), _arrays(folder / _MOVING)
        faces = Faces(of["faces_ends"], of["faces_z"], of["faces_glass"])
        solids = Solids(*(of[f"solids_{name}"] for name in Solids._fields))
        kerb = float(of["ground_kerb"])
        ground = Ground(of["ground_slope"], of["ground_bend"], of["ground_pavements"], kerb)
        ceiling, seed = float(of["ceiling"]), int(of["colour_seed"])
        parts = Solids(open_npy(folder / _POSE), *(moves[name] for name in Solids._fields[1:]))
        moving = MovingSurfaces(moves["stamp_ns"], parts)
        T_world_camera = np.array(open_npy(folder / _CAMERAS))
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise InputError(f"is damaged: {error}", where=str(folder)) from error
    standing = StaticSurfaces(faces, solids, ground, None if np.isnan(ceiling) else ceiling)
    inside = folder / _IMAGES

    def mask(image: int) -> NDArray[np.uint16]:
        return read_image(inside / f"{image:06d}.png")

    def distance(image: int) -> NDArray[np.float32]:
        metres = read_image(inside / _distance(image)).astype(np.float32) / 1e3
        return np.where(metres > 0.0, metres, np.float32(np.inf))

    return ImageTruth(seed, standing, moving, T_world_camera, mask, distance)


def _distance(image: int) -> str:
    return f"{image:06d}-distance.png"


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    with np.load(path, allow_pickle=False) as archive:
        return dict(archive)
