"""Which writer writes what: the one table of formats that recordings are written in."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stillmap.core.errors import InputError
from stillmap.core.files import require_new, require_new_file
from stillmap.core.recording import Recording
from stillmap.io import stillmap_folder
from stillmap.io.carmen.writer import write_log
from stillmap.io.point_cloud import kitti, las, pcd, ply
from stillmap.io.ros.bag_types import BagKind
from stillmap.io.ros.recording_writer import write_recording

# of a recording, to a path, whether what is there is replaced: what could not be said
Write = Callable[[Recording, Path, bool], list[str]]

# fields of a recording that hardly any format has room for, in words
_OPTIONAL = {
    "images": "pictures",
    "T_recorded_base": "poses that the recording states",
    "T_odom_base": "readings of odometry",
}

_POSES, _ODOMETRY = ("T_recorded_base",), ("T_odom_base",)


class Writer(NamedTuple):
    """A format.

    Attributes:
        name: what it is called on the command line.
        about: for people.
        endings: of names of such files, in small letters; () for folders.
        mark: name, or pattern of names, of a file that every such folder holds; "" for files.
        write: writes a recording; it appears whole or not at all.
        holds: which of `_OPTIONAL` it writes.
    """

    name: str
    description: str
    endings: tuple[str, ...]
    marker: str
    write: Write
    fields: tuple[str, ...] = ()


def _write_folder(recording: Recording, path: Path, overwrite: bool) -> list[str]:
    stillmap_folder.write(recording, path, overwrite=overwrite)
    return []


def _write_carmen(recording: Recording, path: Path, overwrite: bool) -> list[str]:  # noqa: ARG001
    return write_log(recording, path)


def _ros(kind: BagKind) -> Write:
    def write(recording: Recording, path: Path, overwrite: bool) -> list[str]:
        return write_recording(recording, path, kind, overwrite=overwrite)

    return write


def _in_folder(write: Callable[..., None]) -> Write:
    def written(recording: Recording, path: Path, overwrite: bool) -> list[str]:
        write(recording, path, overwrite=overwrite)
        return _count_non_returns(recording)

    return written


def _write_kitti(recording: Recording, path: Path, overwrite: bool) -> list[str]:
    lost = _in_folder(kitti.write)(recording, path, overwrite)
    if recording.T_odom_base is None:
        return lost
    stands = recording.T_recorded_base is None
    return [
        "its odometry stands for poses" if stands else "its readings of odometry are left out",
        *lost,
    ]


def _as_cloud(write: Callable[..., None]) -> Write:
    """All scans as one cloud, by the poses that the recording has."""

    def written(recording: Recording, path: Path, overwrite: bool) -> list[str]:
        T, lost = recording.T_recorded_base, []
        if T is None:
            T, lost = recording.T_odom_base, ["the cloud is placed by odometry: maps are better"]
        if T is None:
            D = recording.dimension
            T = np.tile(np.eye(D + 1), (recording.n_scans, 1, 1))
            lost = ["there are no poses: all scans lie at one place"] if len(T) > 1 else []
        write(recording, path, T, overwrite=overwrite)
        return [*lost, *_count_non_returns(recording)]

    return written


def _count_non_returns(recording: Recording) -> list[str]:
    n = recording.n_beams - int(np.count_nonzero(recording.hit))
    return [f"{n} beams that hit nothing are left out"] if n else []


WRITERS = (
    Writer(
        "stillmap",
        "a recording folder",
        (),
        stillmap_folder.HEADER,
        _write_folder,
        ("images", *_POSES, *_ODOMETRY),
    ),
    Writer("ros2", "a ROS 2 bag folder", (), "metadata.yaml", _ros("ros2"), _ODOMETRY),
    Writer(
        "carmen",
        "a CARMEN log",
        (".log", ".clf", ".txt", ".log.gz", ".clf.gz", ".txt.gz"),
        "",
        _write_carmen,
        _ODOMETRY,
    ),
    Writer("bag", "a ROS 1 bag", (".bag",), "", _ros("bag"), _ODOMETRY),
    Writer("db3", "a ROS 2 bag file", (".db3",), "", _ros("db3"), _ODOMETRY),
    Writer("mcap", "an MCAP file", (".mcap",), "", _ros("mcap"), _ODOMETRY),
    Writer("kitti", "a KITTI folder", (), kitti.MARK, _write_kitti, (*_POSES, *_ODOMETRY)),
    Writer("pcd", "a folder of PCD files", (), pcd.MARK, _in_folder(pcd.write), _POSES),
    Writer("ply", "a PLY file", (".ply",), "", _as_cloud(ply.write), (*_POSES, *_ODOMETRY)),
    Writer("las", "a LAS file", (".las", ".laz"), "", _as_cloud(las.write), (*_POSES, *_ODOMETRY)),
)


def format_of_ending(path: Path) -> str | None:
    """The name of the format that files with such an ending have; None: none in particular."""
    name = path.name.lower()
    return next((writer.name for writer in WRITERS if name.endswith(writer.endings)), None)


def find_writer(path: Path, name: str | None = None) -> Writer:
    """The writer of a format given by its name, else by the ending of the path.

    Raises:
        InputError: no format has such an ending.
    """
    wanted = name or format_of_ending(path)
    for writer in WRITERS:
        if writer.name == wanted:
            return writer
    if name or path.suffix:
        known = ", ".join(end for writer in WRITERS for end in writer.endings)
        raise InputError(
            f"no format is called or ends in {name or path.suffix!r}",
            where=str(path),
            hint=f"{known}, or a folder without an ending",
        )
    return WRITERS[0]


def write(
    recording: Recording, path: Path, *, name: str | None = None, overwrite: bool = False
) -> list[str]:
    """Write a recording in the format that the name of the path says, or that is named.

    Args:
        recording: T >= 1 scans.
        path: where to.
        name: of the format; None: by the ending of the path, a recording folder where it has none.
        overwrite: replace a file, or a folder of the same format.

    Returns:
        What of the recording could not be written, a sentence each.

    Raises:
        InputError: the path is taken or cannot be written to, or the format cannot hold such a
            recording.
    """
    writer = find_writer(path, name)
    require_free(path, writer, overwrite)
    if not recording.n_scans:
        raise InputError("holds no scan: there is nothing to write")
    try:
        return [*_unsupported_fields(recording, writer), *writer.write(recording, path, overwrite)]
    except InputError as error:
        raise InputError(error.what, where=error.where or str(path), hint=error.hint) from error


def require_free(path: Path, writer: Writer, overwrite: bool) -> None:
    """Refuses to write over anything but what was asked to be replaced.

    Raises:
        InputError: there is something, of another kind or not to be replaced.
    """
    if writer.marker:
        require_new(path, writer.marker, overwrite)
    else:
        require_new_file(path, overwrite)


def _unsupported_fields(recording: Recording, writer: Writer) -> list[str]:
    return [
        f"its {words} are left out"
        for field, words in _OPTIONAL.items()
        if getattr(recording, field) is not None and field not in writer.fields
    ]
