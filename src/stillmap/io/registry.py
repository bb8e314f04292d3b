"""The table of formats that are read (`FORMATS`), and detection of a file's format.

The table of formats that are written is in `writers.py`; `reader.py` reads a recording by this one.
Modules of formats are loaded for a recording of theirs alone.
"""

import shlex
from collections.abc import Callable, Sequence
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from stillmap.core.errors import InputError, explaining_damage
from stillmap.core.recording import Recording
from stillmap.io import rgbd, stillmap_folder
from stillmap.io.builder import ReadContext
from stillmap.io.carmen.log import SCAN_KINDS
from stillmap.io.point_cloud import e57, kitti, las, pcd, ply, threedtk
from stillmap.io.ros import messages
from stillmap.io.text_lines import contains_files, has_extension, read_head
from stillmap.prepare.lasers import RawLasers
from stillmap.prepare.time_window import TimeWindow, select_time

RIG_FOLDERS = ("horizontal", "tilting")  # of the two recordings of a simulated robot

_HEAD = 1 << 16  # bytes from which a format is detected
_FORMATS_HINT = "`stillmap info -h` lists the formats"

# reads parts of a run, in order of time, as one recording; others may be further parts
Reader = Callable[[Sequence[Path], ReadContext, Sequence[Path]], Recording | RawLasers]


class Format(NamedTuple):
    """A format that is read.

    Attributes:
        name: readable name.
        endings: of names of its files or folders; they decide where the content does not.
        matches: whether a file with these first bytes, or a folder (None), has the format.
        read: reader of one path, or of parts of one run.
        joins: whether it reads several parts, where that needs more than joining recordings: the
            beams are then those of the whole recording, to the bit.
    """

    name: str
    endings: tuple[str, ...]
    matches: Callable[[Path, bytes | None], bool]
    read: Reader
    joins: bool = False


def _is_carmen(path: Path, start: bytes | None) -> bool:  # noqa: ARG001
    words = {*SCAN_KINDS, b"ODOM", b"PARAM"}
    first_words = (line.split(maxsplit=1)[:1] for line in (start or b"").splitlines())
    return any(word in words for first in first_words for word in first)


def _is_stillmap_folder(path: Path, start: bytes | None) -> bool:
    header = path / stillmap_folder.HEADER
    return header.is_file() if start is None else path.name == stillmap_folder.HEADER


def _read_stillmap_folder(paths: Sequence[Path], context: ReadContext, *_: Any) -> Recording:
    path = paths[0]
    folder, options = path if path.is_dir() else path.parent, context.options
    of_bags = ("topic", "tilting_topic", "base_frame", "odom_frame")
    for name in of_bags:
        if getattr(options, name) is not None:
            what = f"read.{name} is for bags: this recording has no topics and frames"
            raise InputError(what, where=str(path))
    recording = stillmap_folder.read(folder, context.scratch)
    window = TimeWindow(options)
    return select_time(recording, window, str(path)) if window else recording


def load_later(module: str, function: str = "read") -> Any:
    """A function of a module of this room, which is loaded when it is called."""
    return lambda *args: getattr(import_module(f"stillmap.io.{module}"), function)(*args)


def _folder_format(name: str, endings: tuple[str, ...], module: Any, is_one: Any) -> Format:
    return Format(name, endings, lambda path, start: start is None and is_one(path), _one(module))


def _one(module: Any) -> Reader:
    """The reader of a module, which reads one path."""
    return lambda paths, context, _: module.read(paths[0], context)


def _cloud_format(
    name: str, module: Any, has_magic: Callable[[bytes], bool] | bytes = b""
) -> Format:
    """A format of files, detected by first bytes or by name, and of folders of such files."""
    magic, endings = has_magic, module.EXTENSIONS

    def matches(path: Path, start: bytes | None) -> bool:
        if start is None:
            return contains_files(path, endings)
        if not magic:
            return bool(start) and has_extension(path, endings)
        return start.startswith(magic) if isinstance(magic, bytes) else magic(start)

    return Format(name, endings, matches, _one(module))


LOGS = (".log", ".clf", ".txt", ".log.gz", ".clf.gz", ".txt.gz")
_HEADER, _KITTI = (stillmap_folder.HEADER,), ("velodyne/", "velodyne_points/")
FORMATS = (
    Format("stillmap recording", _HEADER, _is_stillmap_folder, _read_stillmap_folder),
    Format("ROS bag", messages.ENDINGS, messages.is_bag, load_later("ros.reader"), joins=True),
    _folder_format("KITTI folder", _KITTI, kitti, kitti.is_kitti_folder),
    _folder_format("RGB-D folder", ("frame-*.depth.png", "depth.txt"), rgbd, rgbd.detect_layout),
    _cloud_format("PCD", pcd, pcd.is_pcd),
    _cloud_format("3DTK", threedtk),
    _cloud_format("E57", e57, e57.MAGIC),
    _cloud_format("LAS", las, las.MAGIC),
    _cloud_format("PLY", ply, ply.is_ply),
    Format("CARMEN log", (*LOGS, ".gz"), _is_carmen, load_later("carmen.reader"), joins=True),
)


def detect_format(path: Path) -> Format:
    """Detect the format of a file or folder by its content, else by its name.

    Raises:
        InputError: there is nothing, or no recording.
    """
    with explaining_damage(repr(str(path)), OSError, what="is no usable path"):
        is_folder, is_file = path.is_dir(), path.is_file()
    if not is_folder and not is_file:
        what = "is no regular file" if path.exists() else "does not exist"
        raise InputError(what, where=str(path))
    start = read_head(path, _HEAD) if is_file else None
    for known in FORMATS:
        if known.matches(path, start):
            return known
    if start is None:
        raise _no_recording_error(path)
    what = "is no recording that stillmap reads"
    if path.stat().st_size == 0:
        what = "is empty"
    elif b"\0" not in start:
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
    shown = ", ".join(map(str, inside[:3])) + ", ..." * (len(inside) > 3)
    if tuple(entry.name for entry in inside) == RIG_FOLDERS:
        hint = f"both: {inside[0]} with tilting={inside[1]}"
    else:
        hint = f"name one: stillmap map {shlex.quote(str(inside[0]))} -o DIR"
    what = f"is no recording but holds {len(inside)}: {shown}"
    return InputError(what, where=str(path), hint=hint)


def _find_recordings(path: Path) -> list[Path]:
    """The entries of a folder that are recordings, by name."""
    try:
        entries = sorted(islice(path.iterdir(), 1000))
    except OSError:
        return []
    return [entry for entry in entries if is_recording(entry)]


def is_recording(path: Path) -> bool:
    """True if a file or folder is a recording by its content; False where it cannot be read."""
    try:
        if path.is_dir():
            return any(known.matches(path, None) for known in FORMATS)
        name = path.name.lower()
        named = [known for known in FORMATS if name.endswith(known.endings) and path.is_file()]
        start = read_head(path, _HEAD) if named else b""
    except (OSError, InputError):
        return False
    return any(known.matches(path, start) for known in named)
