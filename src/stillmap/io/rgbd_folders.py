"""Images, intrinsics and poses in folders of RGB-D cameras.

7-Scenes and 3DMatch: `frame-000000.color.png`, `.depth.png` (millimetres), `.pose.txt` (4 x 4,
camera to world), `camera-intrinsics.txt` there or in the folder above. TUM RGB-D: `depth.txt` and
`rgb.txt` (lines of stamp and file), `groundtruth.txt` (lines of stamp and pose).
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2, se3
from stillmap.core.errors import InputError
from stillmap.core.input_files import InputFile
from stillmap.core.timestamps import parse_ns
from stillmap.io.rigid_transforms import rigid_transform
from stillmap.io.text_lines import read_lines
from stillmap.io.trajectory import read_tum

Float = NDArray[np.float64]

SCENES, TUM = "7-Scenes", "TUM RGB-D"

_FRAME = re.compile(r"frame-([0-9]{1,9})\.(depth|color)\.(png|jpg|jpeg)")
_INTRINSICS = ("camera-intrinsics.txt", "camera.txt")
_RATE = 30  # images per second where no file holds stamps
_MAX_MATRIX_BYTES = 1 << 12  # of a matrix in text
_MAX_POSE_GAP_NS = 100_000_000  # between an image and the poses around it


class Frames(NamedTuple):
    """Contents of a folder.

    Attributes:
        format: name of the format.
        depth, color: stamps (ns) and files, ordered by stamp.
        T_world_camera: poses of the depth images, (4, 4) or None; x right, y down, z ahead.
        K: (3, 3) intrinsics of the depth camera; None where no file holds them.
        default_K: intrinsics assumed where K is None.
        scale: depth units per metre.
        warnings: on what could not be used.
    """

    format: str
    depth: list[tuple[int, Path]]
    color: list[tuple[int, Path]]
    T_world_camera: list[Float | None]
    K: Float | None
    default_K: Float
    scale: float
    warnings: list[str]


def detect_layout(path: Path) -> str | None:
    """SCENES, TUM, or None for other folders."""
    try:
        if (path / "depth.txt").is_file() and (path / "depth").is_dir():
            return TUM
        names = (entry.name for entry in path.iterdir())
        matches = (_FRAME.fullmatch(name) for name in names)
        return SCENES if any(match and match[2] == "depth" for match in matches) else None
    except OSError:
        return None


def list_frames(path: Path) -> Frames:
    """List the images and poses of a folder.

    Raises:
        InputError: there are no depth images.
    """
    return _list_tum(path) if detect_layout(path) == TUM else _list_scenes(path)


def _list_scenes(path: Path) -> Frames:
    by_kind: dict[str, list[tuple[int, Path]]] = {"depth": [], "color": []}
    for entry in path.iterdir():
        match = _FRAME.fullmatch(entry.name)
        if match:
            by_kind[match[2]].append((_nominal_ns(int(match[1])), entry))
    depth = sorted(by_kind["depth"])
    if not depth:
        raise InputError("holds no frame-NNNNNN.depth.png", where=str(path))
    warnings = [f"no file holds stamps: images are taken {_RATE} per second, by their numbers"]
    return Frames(
        SCENES,
        depth,
        sorted(by_kind["color"]),
        [_read_pose(file) for _, file in depth],
        _read_intrinsics(path, warnings),
        np.array([[585.0, 0.0, 320.0], [0.0, 585.0, 240.0], [0.0, 0.0, 1.0]]),
        1000.0,
        warnings,
    )


def _nominal_ns(number: int) -> int:
    return (number * 10**9 + _RATE // 2) // _RATE


def _read_pose(depth: Path) -> Float | None:
    """The pose in the file beside a depth image; None where there is no valid one."""
    numbers = _read_matrix(depth.with_name(depth.name.partition(".")[0] + ".pose.txt"), 16)
    try:
        return None if numbers is None else rigid_transform(numbers[:3, :3], numbers[:3, 3])
    except ValueError:  # lost tracking is marked by NaN
        return None


def _read_intrinsics(path: Path, warnings: list[str]) -> Float | None:
    for folder in (path, Path(path.absolute()).parent):
        for name in _INTRINSICS:
            if not (folder / name).is_file():
                continue
            K = _read_matrix(folder / name, 9)
            if K is not None and np.isfinite(K).all() and K[0, 0] > 0.0 and K[1, 1] > 0.0:
                return K
            warnings.append(f"{name} is not used: it holds no 3 x 3 matrix")
    return None


def _read_matrix(path: Path, count: int) -> Float | None:
    """The square matrix of `count` numbers in a text file; None where there is none."""
    try:
        if not path.is_file():
            return None
        with InputFile(path) as file:
            words = file.read(_MAX_MATRIX_BYTES).split()
        n = round(count**0.5)
        return np.array([float(word) for word in words]).reshape(n, n)
    except (InputError, OSError, ValueError):
        return None


def _list_tum(path: Path) -> Frames:
    warnings: list[str] = []
    depth = _read_list(path / "depth.txt", warnings)
    if not depth:
        raise InputError("lists no image", where=str(path / "depth.txt"))
    has_color = (path / "rgb.txt").is_file()
    color = _read_list(path / "rgb.txt", warnings) if has_color else []
    stamps = np.array([stamp for stamp, _ in depth], np.int64)
    return Frames(
        TUM,
        depth,
        color,
        _interpolate_tum_poses(path / "groundtruth.txt", stamps, warnings),
        _read_intrinsics(path, warnings),
        np.array([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]]),
        5000.0,
        warnings,
    )


def _read_list(path: Path, warnings: list[str]) -> list[tuple[int, Path]]:
    """Stamps and files of a list; other lines are counted in a warning."""
    out, bad = [], 0
    for line in read_lines(path):
        words = line.text.decode("utf-8", "replace").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            stamp, name = words
            if Path(name).is_absolute() or ".." in Path(name).parts or "\0" in name:
                raise ValueError("leads out of the folder")
            out.append((parse_ns(stamp), path.parent / name))
        except ValueError:
            bad += 1
    if bad:
        warnings.append(f"{path.name}: {bad} lines are not a stamp and a file of the folder")
    return sorted(out, key=lambda one: one[0])


def _interpolate_tum_poses(
    path: Path, stamps: NDArray[np.int64], warnings: list[str]
) -> list[Float | None]:
    """Poses at stamps (n,), interpolated on SE(3) between the recorded ones; None: none near."""
    if not path.is_file():
        return [None] * len(stamps)
    try:
        known_ns, poses = read_tum(path)
    except InputError as error:
        warnings.append(f"poses are not used: {error}")
        return [None] * len(stamps)
    order = np.argsort(known_ns, kind="stable")
    known_ns, poses = known_ns[order], poses[order]
    right = np.clip(np.searchsorted(known_ns, stamps), 0, len(known_ns) - 1)
    left = np.where((known_ns[right] > stamps) & (right > 0), right - 1, right)
    gap = (known_ns[right] - known_ns[left]).astype(np.float64)
    share = np.divide(stamps - known_ns[left], gap, out=np.zeros(len(stamps)), where=gap > 0.0)
    T = poses[left] @ se3.exp(share[:, None] * se3.log(se2.inverse(poses[left]) @ poses[right]))
    away = np.maximum(stamps - known_ns[left], known_ns[right] - stamps)
    near = np.abs(away) <= _MAX_POSE_GAP_NS
    return [pose if is_near else None for pose, is_near in zip(T, near.tolist(), strict=True)]
