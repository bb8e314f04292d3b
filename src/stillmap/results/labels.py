"""`beams/`: the label P(c = 1) of every beam, as flat arrays that can be memory-mapped."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.array_folder import open_npy
from stillmap.core.arrays import write_npy
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr


@dataclass(frozen=True, eq=False)
class Labels(ShortRepr):
    """`beams/` of a result of T scans with M beams.

    Attributes:
        stamp_ns: (T,) nanoseconds.
        offset: (T+1,) scan t owns the beams offset[t]:offset[t+1].
        p_static: (M,) P(c = 1); NaN: unusable.
        hit: (M,) whether the beam ended on something.
    """

    stamp_ns: NDArray[np.int64]
    offset: NDArray[np.int64]
    p_static: NDArray[np.float32]
    hit: NDArray[np.bool_]


def write_labels(
    folder: Path,
    recording: Recording,
    p_static: NDArray[np.float32],
    colors: NDArray[np.uint8] | None = None,
) -> None:
    """Writes `stamp_ns`, `offset`, `p_static` and `hit` as .npy files into the new `folder`.

    Args:
        folder: `beams/` of a result; it is made.
        recording: T scans with M beams.
        p_static: (M,) P(c = 1).
        colors: (M, 3) of the end points, written as `colour`; None: without.

    Raises:
        ValueError: labels of another number of beams.
    """
    if p_static.shape != (recording.n_beams,):
        raise ValueError(f"p_static: expected ({recording.n_beams},), got {p_static.shape}")
    folder.mkdir()
    write_npy(folder / "stamp_ns.npy", np.asarray(recording.stamp_ns, np.int64))
    write_npy(folder / "offset.npy", np.asarray(recording.offset, np.int64))
    write_npy(folder / "p_static.npy", np.asarray(p_static, np.float32))
    write_npy(folder / "hit.npy", np.asarray(recording.hit, np.bool_))
    if colors is not None:
        write_npy(folder / "colour.npy", colors)


def read_labels(result: Path) -> Labels:
    """The labels of a result folder.

    Raises:
        InputError: files are missing, damaged, or of inconsistent lengths.
    """
    folder = result / "beams"
    stamp_ns = read_array(folder / "stamp_ns.npy", (None,), "i")
    offset = read_array(folder / "offset.npy", (len(stamp_ns) + 1,), "i")
    beams = int(offset[-1])
    path = folder / "p_static.npy"
    p_static = read_array(path, (beams,), "f")
    for block in arrays.iter_blocks(p_static):
        wrong = np.flatnonzero((p_static[block] < 0) | (p_static[block] > 1))
        if len(wrong):
            beam = block.start + int(wrong[0])
            raise InputError(f"beam {beam} has no probability in [0, 1]", where=str(path))
    return Labels(stamp_ns, offset, p_static, read_array(folder / "hit.npy", (beams,), "b"))


def read_colors(result: Path, beams: int) -> NDArray[np.uint8] | None:
    """(M, 3) colors of the end points of a result's beams; None where there are none.

    Raises:
        InputError: they are damaged, or of another number of beams.
    """
    path = result / "beams" / "colour.npy"
    if not path.exists():
        return None
    colors = read_array(path, (beams, 3), "u")
    if colors.dtype != np.uint8:
        raise InputError(f"holds {colors.dtype}", where=str(path))
    return colors


def read_array(path: Path, shape: tuple[int | None, ...], kinds: str) -> NDArray[Any]:
    """Opens an .npy file; refuses another shape (None: any length) or kind of dtype.

    Raises:
        InputError: names the file and what it holds.
    """
    array = open_npy(path)
    if len(array.shape) != len(shape) or any(
        want not in (None, got) for got, want in zip(array.shape, shape, strict=True)
    ):
        raise InputError(f"is {shape_text(array.shape)}, not {shape_text(shape)}", where=str(path))
    if array.dtype.kind not in kinds:
        raise InputError(f"holds {array.dtype}", where=str(path))
    return array


def shape_text(shape: tuple[int | None, ...]) -> str:
    return f"({', '.join('any' if n is None else str(n) for n in shape)})"
