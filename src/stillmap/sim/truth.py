"""The truth of a simulation and its files: read by the scores, never by the mapping."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_folder import open_npy, read_npz, write_arrays
from stillmap.core.array_types import Bool, Float, Float32, Int32, Int64
from stillmap.core.arrays import write_npy, write_npz
from stillmap.core.errors import InputError, explaining_damage
from stillmap.core.json import read_json, write_json
from stillmap.io.cameras import read_image, write_png
from stillmap.io.trajectory import write_tum
from stillmap.sim.geometry import Faces, Ground, MovingSurfaces, Solids, StaticSurfaces

FOLDER = "truth"
SCENE = "scene.json"
ARRAYS = ("static", "mover", "T_world_base", "walls", "movers")
OPTIONAL = ("lasting", "T_base_sensor", "thing")
IMAGES, CAMERAS = "images", "T_world_camera.npy"
STANDING, MOVING, POSE = "standing.npz", "moving.npz", "moving_pose.npy"
_MAX_DISTANCE = 65.535  # m, of a 16-bit image in millimetres
_MAX_SCENE, _MAX_ARRAY = 64 << 20, 1 << 31  # bytes of the file, of an unpacked array


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

    static: Bool
    mover: Int32
    T_world_base: Float
    walls: Float
    movers: Float
    scene: dict[str, Any]
    lasting: Float = field(default_factory=lambda: np.empty((0, 4)))
    T_base_sensor: Float | None = None
    thing: Int32 | None = None


def load_truth(path: str | Path) -> Truth:
    """Load the truth of a simulation, given its folder or the `truth` folder inside.

    Raises:
        InputError: there is none, or it is damaged.
    """
    folder = _find_folder(path, SCENE, "truth", "")
    names = (*ARRAYS, *(name for name in OPTIONAL if (folder / f"{name}.npy").exists()))
    with explaining_damage(folder, TypeError):
        arrays = {name: np.array(open_npy(folder / f"{name}.npy")) for name in names}
        return Truth(**arrays, scene=read_json(folder / SCENE, _MAX_SCENE))


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
    distance: Callable[[int], Float32]


def load_image_truth(path: str | Path) -> ImageTruth:
    """Load the truth about images, given the folder of a simulation or the `truth` inside.

    Raises:
        InputError: there is none, or it is damaged.
    """
    folder = _find_folder(path, STANDING, "truth about images", " with cameras")
    with explaining_damage(folder, TypeError, KeyError, OverflowError):
        of, moves = (read_npz(folder / name, None, _MAX_ARRAY) for name in (STANDING, MOVING))
        faces = Faces._make(of[f"faces_{field}"] for field in Faces._fields)
        solids = Solids._make(of[f"solids_{field}"] for field in Solids._fields)
        ground = Ground._make(of[f"ground_{field}"] for field in Ground._fields)
        ceiling, seed = float(of["ceiling"]), int(of["colour_seed"])
        parts = Solids(open_npy(folder / POSE), *(moves[name] for name in Solids._fields[1:]))
        moving = MovingSurfaces(moves["stamp_ns"], parts)
        T_world_camera = np.array(open_npy(folder / CAMERAS))
    standing = StaticSurfaces(faces, solids, ground, None if np.isnan(ceiling) else ceiling)

    def mask(image: int) -> NDArray[np.uint16]:
        return read_image(_image_files(folder, image)[0])

    def distance(image: int) -> Float32:
        metres = read_image(_image_files(folder, image)[1]).astype(np.float32) / 1e3
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


def _image_files(folder: Path, image: int) -> tuple[Path, Path]:
    """Mask and distances of an image, in a truth folder."""
    return folder / IMAGES / f"{image:06d}.png", folder / IMAGES / f"{image:06d}-distance.png"


def write_truth(truth: Truth, stamp_ns: Int64, folder: Path) -> None:
    """Write the truth about the beams of a recording into its folder."""
    inside = folder / FOLDER
    inside.mkdir()
    arrays = {name: getattr(truth, name) for name in (*ARRAYS, *OPTIONAL)}
    if not len(truth.lasting):
        del arrays["lasting"]
    write_arrays(inside, arrays)
    write_tum(inside / "trajectory.tum", stamp_ns, truth.T_world_base)
    write_json(inside / SCENE, truth.scene)


def write_image_truth(surfaces: ImageTruth, folder: Path) -> None:
    """Write the truth about images, but for masks and distances; see `write_seen`."""
    (folder / IMAGES).mkdir()
    faces, solids, ground, ceiling = surfaces.standing
    standing = {
        f"{name}_{key}": np.asarray(value)
        for name, part in (("faces", faces), ("solids", solids), ("ground", ground))
        for key, value in part._asdict().items()
    }
    standing["ceiling"] = np.array(np.nan if ceiling is None else ceiling)
    standing["colour_seed"] = np.array(surfaces.colour_seed)
    write_npz(folder / STANDING, standing)
    moving = surfaces.moving.solids._asdict()
    write_npy(folder / POSE, moving.pop("pose"))
    write_npz(folder / MOVING, {"stamp_ns": surfaces.moving.stamp_ns, **moving})
    write_npy(folder / CAMERAS, surfaces.T_world_camera)


def write_seen(folder: Path, image: int, mask: NDArray[np.uint16], distance: Float32) -> None:
    """Write mask and distances of an image into a truth folder."""
    paths = _image_files(folder, image)
    write_png(mask, paths[0])
    near = np.where(distance < _MAX_DISTANCE, distance, 0.0)
    write_png(np.rint(1e3 * near).astype(np.uint16), paths[1])
