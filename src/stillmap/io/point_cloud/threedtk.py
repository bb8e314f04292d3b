"""3DTK scans: `scan000.3d` (or `.3d.gz`) with `scan000.pose`.

Centimetres, x right, y up, z ahead, left-handed; stillmap has metres, x ahead, y left, z up. A pose
is a position and intrinsic x-y-z Euler angles in degrees.
"""

from functools import partial
from pathlib import Path

import numpy as np

from stillmap.core.array_types import Float
from stillmap.core.errors import InputError
from stillmap.core.input_files import read_bytes
from stillmap.core.recording import Recording
from stillmap.core.source import Source
from stillmap.io.builder import ReadContext
from stillmap.io.point_cloud.clouds import Cloud, CloudSource, build_recording, files_of
from stillmap.io.point_cloud.table import TableLayout, is_blank, read_columns, require_all
from stillmap.io.text_lines import read_lines, strip_extension
from stillmap.io.trajectory import rigid_transform

EXTENSIONS = (".3d", ".3d.gz")

_MAX_POSE = 1 << 12  # bytes
_METRES = 0.01
# maximum-range code: width of the values and gap to the hits (m), minimum share of the points
_CODE_WIDTH, _CODE_GAP, _MIN_CODE_SHARE = 0.012, 0.3, 0.001
# rotation from the axes of 3DTK to ours
_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_POINT = np.dtype([(name, "<f8") for name in "xyz"])


def read(path: Path, context: ReadContext) -> Recording:
    """Read one 3DTK scan or a folder of them.

    Raises:
        InputError: no scan can be read.
    """
    files = files_of(path, EXTENSIONS)
    code = _find_max_range_code(files) if context.options.max_range is None else None
    notes = Source(str(path), format="3DTK", max_range=code)
    if code is not None:
        notes.warnings.append(f"ranges from {code:.2f} m on are a maximum-range code of the laser")
    sources = [CloudSource(file.name, partial(_read_cloud, file)) for file in files]
    return build_recording(sources, notes, context, single=path.is_file())


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
        is_code = codes > _MIN_CODE_SHARE * len(length) and codes >= 20 and 20 * below < codes
        return float(np.floor(100.0 * (top - _CODE_WIDTH)) / 100.0) if is_code else None
    return None


def _read_cloud(path: Path) -> Cloud:
    lines, rows = _read_heading(path)
    layout = TableLayout(path, _POINT, -1, lines=lines, text=True)
    columns = require_all(read_columns(layout, "xyz"), rows, path)
    blocks = [np.stack(block, axis=1) for block in columns]
    points = np.concatenate([np.empty((0, 3)), *blocks])
    return Cloud(_METRES * points @ _AXES.T, _read_pose(path))


def _read_heading(path: Path) -> tuple[int, int]:
    """Number of lines before the first point, and count of points that the first one states.

    Raises:
        InputError: there are none.
    """
    for line in read_lines(path):
        if not is_blank(line.text):
            words = line.text.split()
            is_point = len(words) >= 3 and not words[0].startswith(b"#")
            is_count = len(words) == 1 and words[0].isdigit() and len(words[0]) < 10
            return line.number - is_point, int(words[0]) if is_count else -1
    raise InputError("is empty", where=str(path))


def _read_pose(path: Path) -> Float | None:
    """(4, 4) pose in the file beside a scan; None where there is no valid one."""
    from scipy.spatial.transform import Rotation

    file = path.with_name(strip_extension(path.name, EXTENSIONS) + ".pose")
    try:
        words = read_bytes(file, _MAX_POSE).split()
        position, angles = np.array([float(word) for word in words[:6]]).reshape(2, 3)
        R = Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()
        return rigid_transform(_AXES @ R @ _AXES.T, _METRES * _AXES @ position)
    except (InputError, OSError, ValueError):
        return None
