"""Image files, read and written with Pillow."""

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

_MODES_16_BIT = {"I;16", "I;16B", "I;16L", "I;16N", "I"}


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
        if image.mode == "L":
            return np.array(image)
        if image.mode in _MODES_16_BIT:
            return np.array(image).astype(np.uint16)
        if image.mode == "F":
            return np.array(image, np.float32)
        return np.array(image.convert("RGB"))


def write_png(image: NDArray[Any], path: Path) -> None:
    """Write an integer image as PNG; see `read_image` for its shape and type."""
    # higher levels take ten times as long
    Image.fromarray(image).save(path, format="PNG", compress_level=1)


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
            with Image.open(path) as image:
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
