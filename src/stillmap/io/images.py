"""Pictures in files, by Pillow."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from stillmap.core.errors import InputError

EXTENSIONS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm", ".pgm")

_DEEP = {"I;16", "I;16B", "I;16L", "I;16N", "I"}


def read_image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the header alone.

    Raises:
        InputError: no picture, or it cannot be read.
    """
    with _opened(path) as image:
        return int(image.size[0]), int(image.size[1])


def read_image(path: Path) -> NDArray[Any]:
    """(height, width, 3) uint8, or (height, width) uint8, uint16 or float32; see Images.read.

    Raises:
        InputError: no picture, damaged, or it cannot be read.
    """
    with _opened(path) as image:
        if image.mode == "L":
            return np.array(image)
        if image.mode in _DEEP:
            return np.array(image).astype(np.uint16)
        if image.mode == "F":
            return np.array(image, np.float32)
        return np.array(image.convert("RGB"))


def write_png(picture: NDArray[Any], path: Path) -> None:
    """Write a PNG of a picture of whole numbers, see `read_picture`."""
    # a packing that is tried hard for takes ten times as long
    Image.fromarray(picture).save(path, format="PNG", compress_level=1)


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    try:
        if not path.is_file():
            what = "is no file" if path.exists() else "is listed, but not there"
            raise InputError(what, where=str(path))
        with warnings.catch_warnings():
            # more pixels than any camera has: a picture that unpacks to more than memory
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            warnings.filterwarnings("ignore", category=UserWarning)
            with Image.open(path) as image:
                yield image
    except UnidentifiedImageError as error:
        raise InputError("is no picture", where=str(path)) from error
    except (OSError, ValueError, SyntaxError, EOFError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        what = f"cannot be read: {reason}" if reason else f"is no picture: {error}"
        raise InputError(what, where=str(path)) from error
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise InputError("is too large a picture", where=str(path)) from error
    except MemoryError as error:  # a length in it promises more than there is
        raise InputError("is no picture: it wants more than the memory", where=str(path)) from error
