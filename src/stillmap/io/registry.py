"""The table of formats that are read (`FORMATS`), and detection of a file's format.

The table of formats that are written is in `writers.py`; `reader.py` reads a recording by this one.
"""

import shlex
from collections.abc import Callable, Sequence
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io import stillmap_folder
from stillmap.io.builder import ReadContext
from stillmap.io.carmen.log import SCAN_KINDS
from stillmap.io.point_cloud import signatures
from stillmap.io.ros import messages
from stillmap.io.scan_files import contains_files, has_extension
from stillmap.io.text_lines import read_head
from stillmap.prepare.prepare import apply_options

RIG_FOLDERS = ("horizontal", "tilting")  # of the two recordings of a simulated robot

_HEAD = 1 << 16  # bytes from which a format is detected
_MAX_ENTRIES = 1000  # of a folder, searched for recordings
_MAX_LISTED = 3  # recordings in a message
_FORMATS_HINT = "`stillmap info -h` lists the formats"

Reader = Callable[[Path, ReadContext], Recording]
# reads parts of a run, in order of time, as one recording; others may be further parts
PartsReader = Callable[[Sequence[Path], ReadContext, Sequence[Path]], Recording]


class Format(NamedTuple):
    """A format that is read.

    Attributes:
        name: readable name.
        endings: of names of its files or folders; they decide where the content does not.
        matches: whether a file with these first bytes, or a folder (None), has the format.
        read: reader of a path.
        read_parts: reader of parts of one run, where that needs more than joining recordings: the
            beams are then those of the whole recording, to the bit. None: it does not.
    """

    name: str
    endings: tuple[str, ...]
    matches: Callable[[Path, bytes | None], bool]
    read: Reader
    read_parts: PartsReader | None = None


def _is_carmen(path: Path, start: bytes | None) -> bool:  # noqa: ARG001
    words = {*SCAN_KINDS, b"ODOM", b"PARAM"}
    first_words = (line.split(maxsplit=1)[:1] for line in (start or b"").splitlines())
    return any(word in words for first in first_words for word in first)


def _is_stillmap_folder(path: Path, start: bytes | None) -> bool:
    header = path / stillmap_folder.HEADER
    return header.is_file() if start is None else path.name == stillmap_folder.HEADER


def _read_stillmap_folder(path: Path, context: ReadContext) -> Recording:
    folder = path if path.is_dir() else path.parent
    recording = stillmap_folder.read(folder, context.scratch)
    try:
        return apply_options(recording, context.options)
    except InputError as error:
        where = error.where or str(path)
        raise InputError(error.what, where=where, hint=error.hint) from error


def _is_kitti_folder(path: Path, start: bytes | None) -> bool:
    if start is not None:
        return False
    from stillmap.io.point_cloud.kitti import is_kitti_folder

    return is_kitti_folder(path)


def _is_rgbd_folder(path: Path, start: bytes | None) -> bool:
    if start is not None:
        return False
    from stillmap.io.rgbd_folders import detect_layout

    return detect_layout(path) is not None


def _reader(module: str) -> Reader:
    """`read` of a module of this room, which is loaded for a recording of its format alone."""

    def read(path: Path, context: ReadContext) -> Recording:
        recording: Recording = import_module(f"stillmap.io.{module}").read(path, context)
        return recording

    return read


def _parts_reader(module: str) -> PartsReader:
    """`read_parts` of a module of this room, likewise."""

    def read_parts(
        paths: Sequence[Path], context: ReadContext, others: Sequence[Path]
    ) -> Recording:
        read = import_module(f"stillmap.io.{module}").read_parts
        recording: Recording = read(paths, context, others)
        return recording

    return read_parts


def _point_cloud_format(
    name: str, endings: tuple[str, ...], has_magic: Callable[[bytes], bool] | None, module: str
) -> Format:
    """A format of files, detected by first bytes or by name, and of folders of such files."""

    def matches(path: Path, start: bytes | None) -> bool:
        if start is None:
            return contains_files(path, endings)
        if has_magic is None:
            return has_extension(path, endings) and len(start) > 0
        return has_magic(start)

    return Format(name, endings, matches, _reader(f"point_cloud.{module}"))


FORMATS = (
    Format(
        "stillmap recording", (stillmap_folder.HEADER,), _is_stillmap_folder, _read_stillmap_folder
    ),
    Format(
        "ROS bag",
        messages.ENDINGS,
        messages.is_bag,
        _reader("ros.reader"),
        _parts_reader("ros.reader"),
    ),
    Format(
        "KITTI folder",
        ("velodyne/", "velodyne_points/"),
        _is_kitti_folder,
        _reader("point_cloud.kitti"),
        _parts_reader("point_cloud.kitti"),
    ),
    Format("RGB-D folder", ("frame-*.depth.png", "depth.txt"), _is_rgbd_folder, _reader("rgbd")),
    _point_cloud_format("PCD", signatures.PCD_EXTENSIONS, signatures.is_pcd, "pcd"),
    _point_cloud_format("3DTK", signatures.THREEDTK_EXTENSIONS, None, "threedtk"),
    _point_cloud_format("E57", signatures.E57_EXTENSIONS, signatures.is_e57, "e57"),
    _point_cloud_format("LAS", signatures.LAS_EXTENSIONS, signatures.is_las, "las"),
    _point_cloud_format("PLY", signatures.PLY_EXTENSIONS, signatures.is_ply, "ply"),
    Format(
        "CARMEN log",
        (".log", ".clf", ".txt", ".log.gz", ".clf.gz", ".txt.gz", ".gz"),
        _is_carmen,
        _reader("carmen.reader"),
        _parts_reader("carmen.reader"),
    ),
)


def detect_format(path: Path) -> Format:
    """Detect the format of a file or folder by its content, else by its name.

    Raises:
        InputError: there is nothing, or no recording.
    """
    try:
        is_folder, is_file = path.is_dir(), path.is_file()
    except (OSError, ValueError) as error:
        raise InputError(f"is no usable path: {error}", where=repr(str(path))) from error
    if not is_folder and not is_file:
        if path.exists():
            raise InputError("is no regular file", where=str(path), hint=_FORMATS_HINT)
        raise InputError("does not exist", where=str(path))
    start = read_head(path, _HEAD) if is_file else None
    for known in FORMATS:
        if known.matches(path, start):
            return known
    if start is None:
        raise _no_recording_error(path)
    what = "is no recording that stillmap reads"
    if path.stat().st_size == 0:
        what = "is empty"
    elif b"\0" in start:
        what = "is binary, no recording that stillmap reads"
    else:
        for known in FORMATS:
            if path.name.lower().endswith(known.endings):
                return known
    raise InputError(what, where=str(path), hint=_FORMATS_HINT)


def _no_recording_error(path: Path) -> InputError:
    """The error for a folder without a format, naming the recordings inside and the next step."""
    if (path / "run.json").is_file():
        return InputError("is a result, no recording", where=str(path))
    inside = _find_recordings(path)
    if not inside:
        return InputError("is a folder without a recording", where=str(path), hint=_FORMATS_HINT)
    more = f" and {len(inside) - _MAX_LISTED} more" if len(inside) > _MAX_LISTED else ""
    shown = ", ".join(map(_describe_entry, inside[:_MAX_LISTED])) + more
    if tuple(one.name for one in inside) == RIG_FOLDERS:
        flat, tilting = inside
        hint = f"both: {flat} with tilting={tilting}"
    else:
        which = "it" if len(inside) == 1 else "one of them"
        hint = f"name {which}: stillmap map {shlex.quote(str(inside[0]))} -o DIR"
    what = "a recording" if len(inside) == 1 else "several recordings"
    return InputError(f"is no recording but holds {what}: {shown}", where=str(path), hint=hint)


def _find_recordings(path: Path) -> list[Path]:
    """The entries of a folder that are recordings, by name."""
    try:
        return [one for one in sorted(islice(path.iterdir(), _MAX_ENTRIES)) if is_recording(one)]
    except OSError:
        return []


def is_recording(path: Path) -> bool:
    """True if a file or folder is a recording by its content; False where it cannot be read."""
    try:
        if path.is_dir():
            return any(known.matches(path, None) for known in FORMATS)
        name = path.name.lower()
        named = [one for one in FORMATS if name.endswith(one.endings) and path.is_file()]
        start = read_head(path, _HEAD) if named else b""
    except (OSError, InputError):
        return False
    return any(known.matches(path, start) for known in named)


def _describe_entry(path: Path) -> str:
    """An entry of a folder, with the size of a file."""
    if path.is_dir():
        return str(path)
    size = float(path.stat().st_size)
    for unit in ("bytes", "kB", "MB"):
        if size < 1000:
            return f"{path} ({size:.3g} {unit})"
        size /= 1000
    return f"{path} ({size:.3g} GB)"
