"""The truth of a simulation: read by the scores, never by the mapping."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_folder import open_npy, read_npz
from stillmap.core.arrays import write_npy, write_npz
from stillmap.core.errors import InputError
from stillmap.core.json import read_json
from stillmap.io.images import read_image
from stillmap.io.trajectory import write_tum
from stillmap.sim.geometry import Faces, Float, Ground, Solids
from stillmap.sim.truth_surfaces import MovingSurfaces, StaticSurfaces

FOLDER = "truth"
IMAGES = "images"  # in it
_STANDING, _MOVING, _POSE = "standing.npz", "moving.npz", "moving_pose.npy"
_CAMERAS = "T_world_camera.npy"
_MAX_SCENE, _MAX_ARRAY = 64 << 20, 1 << 31  # bytes of the file, of an unpacked array
_SCENE = "scene.json"
_ARRAYS = ("static", "mover", "T_world_base", "walls", "movers")
_LASTING = "lasting"  # only where there are any
_MOUNT = "T_base_sensor"  # only where the recorder is wrong about it
_THING = "thing"  # only where movable objects stand still


@dataclass(frozen=True, eq=False)
class Truth:
    """The truth about T scans with M beams in all, among P movers and W walls.

    Attributes:
        static: (M,) bool, whether a static surface reflected the beam.
        mover: (M,) int32, id of the mover that reflected the beam; -1: none, -2: the robot itself,
            -3: the floor, seen by a planar laser that a bump tilted, -4: anything in a mirror.
        T_world_base: (T, D+1, D+1) float64 true poses.
        walls: (W, 4) float64 segments x0, y0, x1, y1 in metres.
        movers: (T, P, 3) float64, pose of each mover at each scan: x, y of its center in metres,
            heading in rad. First people, then doors (heading: from the hinge), then vehicles, then
            movable objects; NaN while absent.
        scene: name, seed and all parameters as JSON; `mover_kinds`: kind of each mover ("person",
            "door", "car", "forklift" or "thing"); with a lidar `mover_sizes`: length, width and
            height of each in metres, null where undefined.
        lasting: (K, 4) faces of moved or added objects, at the end.
        T_base_sensor: (S, 3, 3) true poses of the sensors where the recording has others.
        thing: (M,) int32, index of the movable object that reflected the beam while it stands still
            throughout; -1: none. None where there is no such object.
    """

    static: NDArray[np.bool_]
    mover: NDArray[np.int32]
    T_world_base: NDArray[np.float64]
    walls: NDArray[np.float64]
    movers: NDArray[np.float64]
    scene: dict[str, Any]
    lasting: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 4)))
    T_base_sensor: NDArray[np.float64] | None = None
    thing: NDArray[np.int32] | None = None


def write_truth(truth: Truth, stamp_ns: NDArray[np.int64], folder: Path) -> None:
    """Write the `truth` folder into an existing folder."""
    inside = folder / FOLDER
    inside.mkdir()
    optional = [_LASTING] if len(truth.lasting) else []
    optional += [name for name in (_MOUNT, _THING) if getattr(truth, name) is not None]
    for name in (*_ARRAYS, *optional):
        write_npy(inside / f"{name}.npy", np.asarray(getattr(truth, name)))
    write_tum(inside / "trajectory.tum", stamp_ns, truth.T_world_base)
    (inside / _SCENE).write_text(json.dumps(truth.scene, indent=1) + "\n", encoding="utf-8")


def load_truth(path: str | Path) -> Truth:
    """Load the truth of a simulation, given its folder or the `truth` folder inside.

    Raises:
        InputError: there is none, or it is damaged.
    """
    folder = _find_folder(path, _SCENE, "truth", "")
    optional = [name for name in (_LASTING, _MOUNT, _THING) if (folder / f"{name}.npy").exists()]
    names = (*_ARRAYS, *optional)
    try:
        arrays = {name: np.array(open_npy(folder / f"{name}.npy")) for name in names}
        return Truth(**arrays, scene=read_json(folder / _SCENE, _MAX_SCENE))
    except (TypeError, ValueError) as error:
        raise InputError(f"is damaged: {error}", where=str(folder)) from error


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
    write_npy(folder / _CAMERAS, truth.T_world_camera)


def load_image_truth(path: str | Path) -> ImageTruth:
    """Load the truth about images, given the folder of a simulation or the `truth` inside.

    Raises:
        InputError: there is none, or it is damaged.
    """
    folder = _find_folder(path, _STANDING, "truth about images", " with cameras")
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
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        raise InputError(f"is damaged: {error}", where=str(folder)) from error
    standing = StaticSurfaces(faces, solids, ground, None if np.isnan(ceiling) else ceiling)

    def mask(image: int) -> NDArray[np.uint16]:
        return read_image(image_files(folder, image)[0])

    def distance(image: int) -> NDArray[np.float32]:
        metres = read_image(image_files(folder, image)[1]).astype(np.float32) / 1e3
        return np.where(metres > 0.0, metres, np.float32(np.inf))

    return ImageTruth(seed, standing, moving, T_world_camera, mask, distance)


def _find_folder(path: str | Path, mark: str, what: str, how: str) -> Path:
    """The truth folder, given itself or the folder around it; `mark`: a file that it has.

    Raises:
        InputError: there is none.
    """
    folder = Path(path)
    if (folder / FOLDER).is_dir():
        folder = folder / FOLDER
    if not (folder / mark).is_file():
        hint = f"a folder that 'stillmap simulate' wrote{how}"
        raise InputError(f"holds no {what}", where=str(path), hint=hint)
    return folder


def image_files(folder: Path, image: int) -> tuple[Path, Path]:
    """Mask and distances of an image, in a truth folder."""
    return folder / IMAGES / f"{image:06d}.png", folder / IMAGES / f"{image:06d}-distance.png"


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    return read_npz(path, None, _MAX_ARRAY)
