"""Arrays in `.npy` files, as they lie on the disk."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.texts import require_regular


def open_npy(path: Path) -> NDArray[Any]:
    """The array of a file, read-only and not in memory until it is used.

    Raises:
        InputError: it is missing, damaged, or holds Python objects.
    """
    require_regular(path)
    try:
        with warnings.catch_warnings():
            # of headers that Python 2 wrote, or that are damaged
            warnings.simplefilter("ignore")
            # np.load would also open archives and pickles that bear the name
            loaded: NDArray[Any] = np.lib.format.open_memmap(path, mode="r")
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", where=str(path)) from error
    except Exception as error:  # whatever NumPy's parser makes of damaged bytes
        raise InputError(f"is damaged: {error}", where=str(path)) from error
    return loaded
