"""3DTK scans: `scan000.3d` (or `.3d.gz`) with `scan000.pose`.

Centimetres, x right, y up, z ahead, left-handed; stillmap has metres, x ahead, y left, z up. A pose
is a position and intrinsic x-y-z Euler angles in degrees.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.core.input_files import InputFile
from stillmap.core.recording import Recording
from stillmap.io.builder import ReadContext
from stillmap.io.point_cloud.binary_table import iter_text_lines, parse_numbers
from stillmap.io.point_cloud.scans import Cloud, CloudSource, DatasetInfo, build_recording, files_of
from stillmap.io.point_cloud.signatures import THREEDTK_EXTENSIONS
from stillmap.io.rigid_transforms import rigid_transform
from stillmap.io.scan_files import require_nonempty_file, strip_extension

_MAX_UNPACKED = 1 << 30  # bytes
_MAX_POSE = 1 << 12  # bytes
_BLOCK = 1 << 18  # lines parsed at once
_METRES = 0.01
# maximum-range code: width of the values and gap to the hits (m), minimum share of the points
_CODE_WIDTH, _CODE_GAP, _MIN_CODE_SHARE = 0.012, 0.3, 0.001
# rotation from the axes of 3DTK to ours
_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def read(path: Path, context: ReadContext) -> Recording:
    """Read one 3DTK scan or a folder of them.

    Raises:
        InputError: no scan can be read.
    """
    files, options = files_of(path, THREEDTK_EXTENSIONS), context.options
    info = DatasetInfo(path, "3DTK", [], single=path.is_file())
    code = _find_max_range_code(files) if options.max_range is None else None
    if code is not None:
        info.warnings.append(f"ranges from {code:.2f} m on are a maximum-range code of the laser")
        context = context._replace(options=replace(options, max_range=code))
    sources = [CloudSource(file.name, partial(_read_cloud, file)) for file in files]
    return build_recording(sources, info, context)


def _find_max_range_code(files: list[Path]) -> float | None:
    """Range (m) from which on readings of the first scan are a maximum-range code; None: none.

    A 2D laser on a tilting mount writes one value, or a few neighbouring ones, for beams without a
    return; a gap separates them from the hits.
    """
    for file in files:
        try:
            length = np.linalg.norm(_read_cloud(file).points, axis=1)
        except (InputError, OSError):
            continue
        length = length[np.isfinite(length)]
        top = length.max(initial=0.0)
        codes = int(np.count_nonzero(length > top - _CODE_WIDTH))
        below = int(np.count_nonzero(length > top - _CODE_WIDTH - _CODE_GAP)) - codes
        found = codes > _MIN_CODE_SHARE * len(length) and codes >= 20 and 20 * below < codes
        return float(np.floor(100.0 * (top - _CODE_WIDTH)) / 100.0) if found else None
    return None


def _read_cloud(path: Path) -> Cloud:
    require_nonempty_file(path)
    lines = iter_text_lines(path, limit=_MAX_UNPACKED)
    blocks = []
    # the first line may be a size or a heading
    first = next(lines, b"")
    if is_point(first):
        blocks.append(parse_numbers(iter([first]), 1, (0, 1, 2), path))
    while len(block := parse_numbers(lines, _BLOCK, (0, 1, 2), path)):
        blocks.append(block)
    points = np.concatenate(blocks) if blocks else np.empty((0, 3))
    return Cloud(_METRES * points @ _AXES.T, _read_pose(path))


def is_point(first_line: bytes) -> bool:
    """True if the first line of a scan is a point."""
    return len(first_line.split()) >= 3 and not first_line.lstrip().startswith(b"#")


def pose_file(path: Path) -> Path:
    """The file beside a scan that holds its pose."""
    return path.with_name(strip_extension(path.name, THREEDTK_EXTENSIONS) + ".pose")


def _read_pose(path: Path) -> NDArray[np.float64] | None:
    """(4, 4) pose in the file beside a scan; None where there is no valid one."""
    file = pose_file(path)
    try:
        if not file.is_file():
            return None
        with InputFile(file) as opened:
            words = opened.read(_MAX_POSE).split()
        numbers = np.array([float(word) for word in words[:6]])
        position, angles = numbers.reshape(2, 3)
        R = scipy.spatial.transform.Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()
        return rigid_transform(_AXES @ R @ _AXES.T, _METRES * _AXES @ position)
    except (InputError, OSError, ValueError):
        return None
