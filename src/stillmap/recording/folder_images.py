"""Pictures in stillmap's own recording folder: PNG files, and cameras in the header.

Pictures of fractions (depth in metres) are `.npy` files of float32.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.arrays import open_npy
from stillmap.errors import InputError
from stillmap.recording.images import Camera, Images
from stillmap.recording.pictures import read_picture, write_picture

FOLDER = "images"


def write(images: Images, folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Write pictures, stamps and cameras into an existing folder.

    Returns:
        Entries for the header, and a warning where pictures could not be read: they are left out.
    """
    (folder / FOLDER).mkdir()
    kept: list[int] = []
    lost: list[str] = []
    for image in range(len(images)):
        try:
            picture = images.read(image)
        except InputError as error:
            lost.append(str(error))
            continue
        _write_one(picture, folder / FOLDER / f"{len(kept):06d}")
        kept.append(image)
    np.save(folder / "image_stamp_ns.npy", images.stamp_ns[kept], allow_pickle=False)
    np.save(folder / "image_camera.npy", images.camera[kept], allow_pickle=False)
    header = {"images": len(kept), "cameras": [_described(camera) for camera in images.cameras]}
    return header, [f"{len(lost)} pictures left out: {lost[0]}"] if lost else []


def _write_one(picture: NDArray[Any], path: Path) -> None:
    if picture.dtype.kind == "f":
        np.save(path.with_suffix(".npy"), picture.astype(np.float32), allow_pickle=False)
    else:
        write_picture(picture, path.with_suffix(".png"))


def _described(camera: Camera) -> dict[str, Any]:
    return {
        "name": camera.name,
        "width": camera.width,
        "height": camera.height,
        "K": None if camera.K is None else camera.K.tolist(),
        "model": camera.model,
        "distortion": camera.distortion.tolist(),
        "T_base_camera": None if camera.T_base_camera is None else camera.T_base_camera.tolist(),
    }


def read(
    folder: Path, described: Any, stamp_ns: NDArray[np.int64], camera: NDArray[np.int32]
) -> Images:
    """The pictures of a folder, read one by one when they are asked for.

    Args:
        folder: the recording.
        described: the header's "cameras".
        stamp_ns, camera: (N,) as they lie beside it.

    Raises:
        InputError: the entries of the header do not fit.
    """
    try:
        cameras = tuple(_camera(one) for one in described)
        return Images(stamp_ns, camera, cameras, partial(_load, folder / FOLDER))
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"is damaged: its cameras: {error}", where=str(folder)) from error


def _camera(one: dict[str, Any]) -> Camera:
    return Camera(
        name=str(one["name"]),
        width=int(one["width"]),
        height=int(one["height"]),
        K=_matrix(one["K"], 3),
        model=str(one["model"]),
        distortion=np.array(one["distortion"], np.float64).reshape(-1),
        T_base_camera=_matrix(one["T_base_camera"], 4),
    )


def _matrix(rows: Any, n: int) -> NDArray[np.float64] | None:
    return None if rows is None else np.array(rows, np.float64).reshape(n, n)


def _load(folder: Path, image: int) -> NDArray[Any]:
    path = folder / f"{image:06d}.npy"
    png = path.with_suffix(".png")
    if png.exists() or not path.exists():
        return read_picture(png)
    picture = open_npy(path)
    if picture.dtype != np.float32 or picture.ndim != 2:
        raise InputError(f"is damaged: {picture.shape} {picture.dtype}", where=str(path))
    return np.array(picture)
