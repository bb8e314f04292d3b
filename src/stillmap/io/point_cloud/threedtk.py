"""Folders of 3DTK: `scan000.3d` (or `.3d.gz`) with `scan000.pose`.

Centimetres, x right, y up, z ahead, left-handed; stillmap has metres, x ahead, y left, z up. A pose
is a position and three angles in degrees, about x, then the turned y, then the turned z.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io.point_cloud.binary_table import iter_text_lines, parse_numbers
from stillmap.io.point_cloud.files import (
    list_files,
    require_nonempty_file,
    rigid_transform,
    strip_extension,
)
from stillmap.io.point_cloud.scans import Cloud, CloudSource, DatasetInfo, build_recording
from stillmap.io.text_lines import Progress
from stillmap.preprocessing.options import ReadOptions

EXTENSIONS = (".3d", ".3d.gz")

_LARGEST_UNPACKED = 1 << 30  # bytes
_LARGEST_POSE = 1 << 12  # bytes
_BLOCK = 1 << 18  # lines read together
_METRES = 0.01
# what tells codes for "nothing came back": so near to each other, so far from the rest (m), so many
_CODES, _GAP, _FEW = 0.012, 0.3, 0.001
# of the axes of 3DTK to ours
_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def read(
    path: Path,
    options: ReadOptions,
    progress: Progress | None = None,
    scratch: Path | None = None,
) -> Recording:
    """Read one scan of 3DTK or a folder of them.

    Raises:
        InputError: no scan can be read.
    """
    files = [path] if path.is_file() else list_files(path, EXTENSIONS)
    known = DatasetInfo(path, "3DTK", [], single=path.is_file())
    code = _code(files) if options.max_range is None else None
    if code is not None:
        known.warnings.append(f"nothing came back from {code:.2f} m on: a code of the laser")
        options = replace(options, max_range=code)
    sources = [CloudSource(file.name, partial(_cloud, file)) for file in files]
    return build_recording(sources, known, options, progress, scratch)


def _code(files: list[Path]) -> float | None:
    """Metres from which on ranges of the first scan are codes for "nothing came back", or None.

    A 2D laser on a tilting mount writes one range, or a few beside each other, where it sees
    nothing; they stand off from what it does see.
    """
    for file in files:
        try:
            length = np.linalg.norm(_cloud(file).points, axis=1)
        except (InputError, OSError):
            continue
        length = length[np.isfinite(length)]
        top = length.max(initial=0.0)
        codes = int(np.count_nonzero(length > top - _CODES))
        below = int(np.count_nonzero(length > top - _CODES - _GAP)) - codes
        found = codes > _FEW * len(length) and codes >= 20 and 20 * below < codes
        return float(np.floor(100.0 * (top - _CODES)) / 100.0) if found else None
    return None


def _cloud(path: Path) -> Cloud:
    require_nonempty_file(path)
    lines = iter_text_lines(path, limit=_LARGEST_UNPACKED)
    blocks = []
    # the first line may be a size or a heading
    first = next(lines, b"")
    if len(first.split()) >= 3 and not first.lstrip().startswith(b"#"):
        blocks.append(parse_numbers(iter([first]), 1, (0, 1, 2), path))
    while len(block := parse_numbers(lines, _BLOCK, (0, 1, 2), path)):
        blocks.append(block)
    points = np.concatenate(blocks) if blocks else np.empty((0, 3))
    return Cloud(_METRES * points @ _AXES.T, _pose(path))


def _pose(path: Path) -> NDArray[np.float64] | None:
    """(4, 4) of the file beside a scan; None where there is none that can be used."""
    file = path.with_name(strip_extension(path.name, EXTENSIONS) + ".pose")
    try:
        if not file.is_file():
            return None
        with file.open("rb") as opened:
            words = opened.read(_LARGEST_POSE).split()
        numbers = np.array([float(word) for word in words[:6]])
        position, angles = numbers.reshape(2, 3)
        R = scipy.spatial.transform.Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()
        return rigid_transform(_AXES @ R @ _AXES.T, _METRES * _AXES @ position)
    except (OSError, ValueError):
        return None
