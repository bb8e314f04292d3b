"""Images, and camera calibrations of a recording, overridden or added by `--cameras FILE`.

Image files are read and written with Pillow. The camera file is TOML, one table per camera:

["/front/image_raw"]             # topic or folder, named as in `stillmap info`
fx = 525.0                       # and fy, cx, cy; or K = [[...], [...], [...]]
model = "plumb_bob"
distortion = [0.26, -0.95, -0.005, 0.003, 1.16]
translation = [0.2, 0.0, 0.5]    # of T_base_camera; camera axes: x right, y down, z ahead
quaternion = [-0.5, 0.5, -0.5, 0.5]
"""

import io
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from PIL import Image

from stillmap.core.array_types import Float, Int32, Int64
from stillmap.core.camera import Camera, Images
from stillmap.core.config import CheckedOptions, load_toml, override
from stillmap.core.errors import InputError
from stillmap.core.input_files import InputFile
from stillmap.core.recording import Recording
from stillmap.io import text_lines
from stillmap.io.trajectory import pose_from_quaternion, pose_from_row, rigid_transform

# counts of the numbers of each distortion model
MODELS = {"": (0,), "plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}

_Number = Annotated[float, Meta(ge=-1e6, le=1e6)]  # pixels, metres, seconds
_Pixels = Annotated[int, Meta(ge=1, le=1 << 16)]
_Matrix = list[_Number | list[_Number]]
_Three = Annotated[list[_Number], Meta(min_length=3, max_length=3)]
_Four = Annotated[list[_Number], Meta(min_length=4, max_length=4)]
_Path = Annotated[str, Meta(pattern=r"^[^\x00]+$")]


@dataclass(frozen=True)
class CameraOverride(CheckedOptions):
    """Values of one camera; None: not given. See the beginning of this file.

    `time_offset` (s) is added to the stamps of its images; `folder` holds images outside the
    recording, `times` their stamps, else their names do.
    """

    K: _Matrix | None = None
    fx: _Number | None = None
    fy: _Number | None = None
    cx: _Number | None = None
    cy: _Number | None = None
    width: _Pixels | None = None
    height: _Pixels | None = None
    model: Literal["", "plumb_bob", "rational_polynomial", "equidistant"] | None = None
    distortion: list[_Number] | None = None
    T_base_camera: _Matrix | None = None
    translation: _Three | None = None
    quaternion: _Four | None = None
    rpy: _Three | None = None
    time_offset: _Number = 0.0
    folder: _Path | None = None
    times: _Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.width is None) != (self.height is None):
            raise ValueError("'width' and 'height' go together")
        if self.times is not None and self.folder is None:
            raise ValueError("'times' is for a 'folder' of images")
        if self.distortion is not None and self.model is None:
            raise ValueError(f"'distortion' needs 'model': one of {', '.join(MODELS)}")
        count = len(self.distortion or ())
        if self.model is not None and count not in MODELS[self.model]:
            needed = " or ".join(map(str, MODELS[self.model]))
            what = f"'distortion' of model '{self.model}' needs {needed} numbers"
            raise ValueError(f"{what}, got {count}")
        self.intrinsics()
        self.pose()

    def intrinsics(self) -> Float | None:
        """(3, 3) pinhole matrix."""
        given = [v for v in (self.fx, self.fy, self.cx, self.cy) if v is not None]
        if len(given) not in (0, 4) or (given and self.K is not None):
            raise ValueError("give either 'K', or 'fx', 'fy', 'cx' and 'cy'")
        if not given and self.K is None:
            return None
        if given:
            fx, fy, cx, cy = given
        K = _to_matrix("K", [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]] if given else self.K, 3)
        if not (K[0, 0] > 0.0 and K[1, 1] > 0.0 and K[1, 0] == 0.0):
            raise ValueError("focal lengths must be positive")
        return K

    def pose(self) -> Float | None:
        """(4, 4) T_base_camera."""
        t, rotations = self.translation, [v for v in (self.quaternion, self.rpy) if v is not None]
        if self.T_base_camera is not None:
            if t is not None or rotations:
                raise ValueError("'T_base_camera' excludes 'translation', 'quaternion' and 'rpy'")
            return pose_from_row(_to_matrix("T_base_camera", self.T_base_camera, 4)[:3])
        if t is None and not rotations:
            return None
        if t is None or len(rotations) != 1:
            raise ValueError("a pose needs 'translation', and one of 'quaternion' and 'rpy'")
        if self.quaternion is not None:
            return pose_from_quaternion(self.quaternion[3:] + self.quaternion[:3], t)
        from scipy.spatial.transform import Rotation  # slow to load

        return rigid_transform(Rotation.from_euler("xyz", rotations[0]).as_matrix(), t)

    @property
    def time_offset_ns(self) -> int:
        """Nanoseconds added to the stamps of its images."""
        return round(self.time_offset * 1e9)

    def apply_to(self, camera: Camera) -> Camera:
        """The camera with the given values in place of its own."""
        distortion = None if self.model is None else np.array(self.distortion or (), np.float64)
        given: dict[str, Any] = {
            "K": self.intrinsics(),
            "width": self.width,
            "height": self.height,
            "model": self.model,
            "distortion": distortion,
            "T_base_camera": self.pose(),
        }
        return replace(camera, **{name: v for name, v in given.items() if v is not None})


def _to_matrix(name: str, numbers: Any, n: int) -> Float:
    """A matrix (n, n) whose last row is 0 ... 0 1.

    Raises:
        ValueError: it is none.
    """
    try:
        matrix = np.array(numbers, np.float64).reshape(n, n)
    except ValueError as error:
        raise ValueError(f"'{name}' needs {n} x {n} numbers") from error
    if not np.array_equal(matrix[-1], np.eye(n)[-1]):
        raise ValueError(f"the last row of '{name}' must be {', '.join('0' * (n - 1))}, 1")
    return matrix


def read_camera_file(path: Path, known: Sequence[str] | None = None) -> dict[str, CameraOverride]:
    """Read the cameras of a file, by name.

    Args:
        path: the file.
        known: names of cameras that need no image folder; None: all.

    Raises:
        InputError: it cannot be read, or a name, key or value is invalid.
    """
    out, where = {}, str(path)
    for name, table in load_toml(path).items():
        if not isinstance(table, Mapping):
            hint = "a camera is a table: [NAME], with its values below"
            raise InputError(f"'{name}' stands outside of a camera", where=where, hint=hint)
        if known is not None and name not in known and "folder" not in table:
            hint = f"has: {', '.join(known) or 'no images'}; folder = '...' adds some"
            raise InputError(f"there is no camera '{name}'", where=where, hint=hint)
        try:
            out[name] = override(CameraOverride(), table)
        except InputError as error:
            what = f"camera '{name}': {error.what}"
            raise InputError(what, where=where, hint=error.hint) from error
    if not out:
        raise InputError("names no camera", where=where, hint="a table for each: [NAME]")
    return out


_NO_IMAGES = Images(np.zeros(0, np.int64), np.zeros(0, np.int32), (), lambda _: np.zeros((0, 0)))


def apply_camera_file(recording: Recording, path: Path) -> Recording:
    """Apply the calibrations of a camera file, and add the image folders that it names.

    Raises:
        InputError: the file is invalid, or names a camera or images that do not exist.
    """
    images = recording.images or _NO_IMAGES
    recorded = [camera.name for camera in images.cameras]
    depth = [sensor.name for sensor in recording.source.sensors if sensor.grid]
    overrides = read_camera_file(path, [*recorded, *depth])
    parts = [_apply_overrides(images, overrides)]
    for name, given in overrides.items():
        if given.folder is None:
            continue
        if name in recorded:
            what = f"camera '{name}' has images in the recording: 'folder' is for others"
            raise InputError(what, where=str(path))
        try:
            parts.append(_read_folder(name, given, path.parent / given.folder, path))
        except InputError as error:
            hint = error.hint or f"camera '{name}' of {path}"
            raise InputError(error.what, where=error.where, hint=hint) from error
    merged = merge_images(parts)
    return replace(recording, images=merged if merged.cameras else None)


def images_from_files(files: Sequence[tuple[int, Path]], camera: Camera) -> Images:
    """The images of one camera, from stamps (ns) and files in any order."""
    stamp_ns = np.array([stamp for stamp, _ in files], np.int64)
    number = np.zeros(len(files), np.int32)
    return order_images(stamp_ns, number, (camera,), lambda image: read_image(files[image][1]))


def order_images(
    stamp_ns: Int64, camera: Int32, cameras: Sequence[Camera], load: Callable[[int], NDArray[Any]]
) -> Images:
    """Images of stamps (N,) in any order, by which `load` reads them."""
    order = np.argsort(stamp_ns, kind="stable")
    in_order = stamp_ns[order], camera[order]
    return Images(*in_order, tuple(cameras), lambda image: load(int(order[image])))


def merge_images(parts: Sequence[Images]) -> Images:
    """All images, ordered by stamp; cameras of the same name are one."""
    if len(parts) == 1:
        return parts[0]
    cameras: dict[str, Camera] = {}
    for camera in (camera for part in parts for camera in part.cameras):
        cameras.setdefault(camera.name, camera)
    numbers = {name: number for number, name in enumerate(cameras)}
    stamp_ns = np.concatenate([part.stamp_ns for part in parts])
    number_of = np.concatenate(
        [np.array([numbers[each.name] for each in part.cameras])[part.camera] for part in parts]
    )
    sources = [(part, image) for part in parts for image in range(len(part))]

    def load(image: int) -> NDArray[Any]:
        part, number = sources[image]
        return part.read(number)

    return order_images(stamp_ns, number_of.astype(np.int32), tuple(cameras.values()), load)


def _apply_overrides(images: Images, overrides: dict[str, CameraOverride]) -> Images:
    """Images of the recording with overridden cameras, sorted again by their shifted stamps."""
    cameras, stamp_ns = list(images.cameras), images.stamp_ns.copy()
    for number, camera in enumerate(cameras):
        given = overrides.get(camera.name)
        if given is not None:
            cameras[number] = given.apply_to(camera)
            stamp_ns[images.camera == number] += given.time_offset_ns
    return order_images(stamp_ns, images.camera, cameras, images.read)


def _read_folder(name: str, given: CameraOverride, folder: Path, where: Path) -> Images:
    """Images of a folder outside the recording."""
    files = text_lines.list_files(folder, EXTENSIONS)
    if not files:
        raise InputError("holds no images", where=str(folder))
    if given.times is not None:
        file = where.parent / given.times
        used = text_lines.stamp_files(files, text_lines.read_times(file), file)
    else:
        stems = [text_lines.strip_extension(file.name, EXTENSIONS) for file in files]
        named = text_lines.stamps_from_names(stems)
        if named is None:
            hint = f"times = 'FILE' in camera '{name}' of {where}: one line of seconds per image"
            raise InputError("holds images whose names are no stamps", where=str(folder), hint=hint)
        used = list(zip(named, files, strict=True))
    if not used:
        raise InputError("holds no usable stamp", where=str(given.times))
    width, height = read_image_size(used[0][1])
    camera = given.apply_to(Camera(name, width, height, None, "", np.zeros(0), None))
    return images_from_files([(stamp + given.time_offset_ns, file) for stamp, file in used], camera)


EXTENSIONS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm", ".pgm")
# whatever the name: for EPS, Pillow starts Ghostscript
_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "PPM", "WEBP")

# of an image: Pillow unpacks it to 4 bytes a pixel, and an array takes 1 to 4
_MAX_PIXELS = 64 << 20
_UNPACKED = 1 << 20  # pixels of an image that become an array at a time

_DAMAGED = (OSError, ValueError, SyntaxError, EOFError, MemoryError)
_TOO_LARGE = (Image.DecompressionBombError, Image.DecompressionBombWarning)
_DTYPES: dict[str, Any] = {  # by Pillow's mode; others become RGB
    **{"L": np.uint8, "F": np.float32},
    **dict.fromkeys(("I;16", "I;16B", "I;16L", "I;16N", "I"), np.uint16),
}


def read_image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the header alone.

    Raises:
        InputError: it is no image, or cannot be read.
    """
    # given a path, Pillow maps files of bare pixels into memory
    with InputFile(path) as file, open_image(file, str(path)) as image:
        return int(image.size[0]), int(image.size[1])


def read_image(path: Path) -> NDArray[Any]:
    """The array of an image file, see `Images.read`.

    Raises:
        InputError: it is no image, damaged, or cannot be read.
    """
    with InputFile(path) as file, open_image(file, str(path)) as image:
        return to_array(image)


def to_array(image: Image.Image) -> NDArray[Any]:
    """The array of an image, some rows at a time: at once it takes twice the memory."""
    dtype, (width, height) = _DTYPES.get(image.mode), image.size
    shape = (height, width) if dtype else (height, width, 3)
    out = np.empty(shape, dtype or np.uint8)
    rows = max(_UNPACKED // max(width, 1), 1)
    for first in range(0, height, rows):
        part = image.crop((0, first, width, min(first + rows, height)))
        out[first : first + rows] = part if dtype else part.convert("RGB")
    return out


def write_png(image: NDArray[Any], path: Path, compress_level: int = 1) -> None:
    """Write an integer image as PNG; see `read_image` for its shape and type.

    Higher levels than 1 take ten times as long.
    """
    buffer = io.BytesIO()  # Pillow does not notice that a disk is full
    Image.fromarray(image).save(buffer, format="PNG", compress_level=compress_level)
    path.write_bytes(buffer.getbuffer())


@contextmanager
def open_image(source: IO[bytes], where: str) -> Iterator[Image.Image]:
    """Open an image.

    Raises:
        InputError: it is none, damaged, or too large.
    """
    try:
        with warnings.catch_warnings():
            # an image that unpacks to more than memory
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            warnings.filterwarnings("ignore", category=UserWarning)
            with Image.open(source, formats=_FORMATS) as image:
                if image.size[0] * image.size[1] > _MAX_PIXELS:
                    raise Image.DecompressionBombError
                yield image
    except (*_DAMAGED, *_TOO_LARGE) as error:
        too_large = isinstance(error, _TOO_LARGE)
        what = "is too large an image" if too_large else "is no image, or damaged"
        if isinstance(error, OSError) and error.strerror:
            what = f"cannot be read: {error.strerror}"
        raise InputError(what, where=where) from error
