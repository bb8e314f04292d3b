"""Image files, read and written with Pillow."""

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from stillmap.core.errors import InputError
from stillmap.core.input_files import InputFile

EXTENSIONS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm", ".pgm")
# whatever the name: for EPS, Pillow starts Ghostscript
_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "PPM")

# of an image: Pillow unpacks it to 4 bytes a pixel, and an array takes 1 to 4
_MAX_PIXELS = 64 << 20
_UNPACKED = 1 << 20  # pixels of an image that become an array at a time

_DTYPES: dict[str, Any] = {  # by Pillow's mode; others become RGB
    **{"L": np.uint8, "F": np.float32},
    **dict.fromkeys(("I;16", "I;16B", "I;16L", "I;16N", "I"), np.uint16),
}


def read_image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the header alone.

    Raises:
        InputError: it is no image, or cannot be read.
    """
    with _open(path) as image:
        return int(image.size[0]), int(image.size[1])


def read_image(path: Path) -> NDArray[Any]:
    """(height, width, 3) uint8, or (height, width) uint8, uint16 or float32; see Images.read.

    Raises:
        InputError: it is no image, damaged, or cannot be read.
    """
    with _open(path) as image:
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
def _open(path: Path) -> Iterator[Image.Image]:
    try:
        if not path.is_file():
            what = "is no file" if path.exists() else "is listed, but not there"
            raise InputError(what, where=str(path))
        with warnings.catch_warnings():
            # an image that unpacks to more than memory
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            warnings.filterwarnings("ignore", category=UserWarning)
            # given a path, Pillow maps files of bare pixels into memory
            with InputFile(path) as file, Image.open(file, formats=_FORMATS) as image:
                if image.size[0] * image.size[1] > _MAX_PIXELS:
                    raise InputError("is too large an image", where=str(path))
                yield image
    except UnidentifiedImageError as error:
        raise InputError("is no image", where=str(path)) from error
    except (OSError, ValueError, SyntaxError, EOFError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        what = f"cannot be read: {reason}" if reason else f"is no image: {error}"
        raise InputError(what, where=str(path)) from error
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise InputError("is too large an image", where=str(path)) from error
    except MemoryError as error:  # a length in a damaged header
        raise InputError("is no image: it does not fit into memory", where=str(path)) from error
