"""The table of formats that are written (`WRITERS`).

The table of formats that are read is in `registry.py`.
"""

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
from stillmap.io.point_cloud.origin import place_clouds
from stillmap.io.ros.messages import BagKind
from stillmap.io.ros.writer import write_recording as write_bag

# (recording, path, overwrite) -> what could not be written, a sentence each
Write = Callable[[Recording, Path, bool], list[str]]

# optional fields of a recording that most formats cannot hold, in words
_OPTIONAL_FIELDS = {
    "images": "images",
    "T_recorded_base": "recorded poses",
    "T_odom_base": "odometry readings",
}
_ODOMETRY, _POSES = ("T_odom_base",), ("T_recorded_base",)


class Writer(NamedTuple):
    """A format that is written.

    Attributes:
        name: on the command line.
        description: for messages.
        endings: of names of such files, in lower case; () for folders.
        marker: name, or pattern of names, of a file that every such folder holds; "" for files.
        write: writes a recording, which appears complete or not at all.
        fields: those of `_OPTIONAL_FIELDS` that it writes.
        max_dimension, max_sensors: of recordings that it holds.
    """

    name: str
    description: str
    endings: tuple[str, ...]
    marker: str
    write: Write
    fields: tuple[str, ...] = ()
    max_dimension: int = 3
    max_sensors: int | None = None


def _write_stillmap(recording: Recording, path: Path, overwrite: bool) -> list[str]:
    stillmap_folder.write(recording, path, overwrite=overwrite)
    return []


def _write_carmen(recording: Recording, path: Path, overwrite: bool) -> list[str]:  # noqa: ARG001
    return write_log(recording, path)


def _write_pcd(recording: Recording, path: Path, overwrite: bool) -> list[str]:
    pcd.write(recording, path, overwrite=overwrite)
    return _describe_non_returns(recording)


def _write_kitti(recording: Recording, path: Path, overwrite: bool) -> list[str]:
    kitti.write(recording, path, overwrite=overwrite)
    losses = _describe_non_returns(recording)
    if recording.T_odom_base is None:
        return losses
    if recording.T_recorded_base is None:
        return ["its odometry is written as poses", *losses]
    return ["its odometry readings are left out", *losses]


def _bag_writer(kind: BagKind, description: str, ending: str, marker: str = "") -> Writer:
    def write(recording: Recording, path: Path, overwrite: bool) -> list[str]:
        return write_bag(recording, path, kind, overwrite=overwrite)

    return Writer(kind, description, (ending,) if ending else (), marker, write, _ODOMETRY)


def _cloud_writer(name: str, endings: tuple[str, ...], write_cloud: Callable[..., None]) -> Writer:
    """A writer of all scans as one point cloud, by the poses that the recording has."""

    def write(recording: Recording, path: Path, overwrite: bool) -> list[str]:  # noqa: ARG001
        T, losses = recording.T_recorded_base, []
        if T is None:
            T, losses = recording.T_odom_base, ["the cloud is placed by odometry: maps are better"]
        if T is None:
            T = np.tile(np.eye(recording.dimension + 1), (recording.n_scans, 1, 1))
            losses = ["there are no poses: all scans lie at one place"] if len(T) > 1 else []
        write_cloud(recording, path, place_clouds(recording, T))
        return [*losses, *_describe_non_returns(recording)]

    return Writer(name, f"a {name.upper()} file", endings, "", write, _POSES + _ODOMETRY)


def _describe_non_returns(recording: Recording) -> list[str]:
    n = recording.n_beams - int(np.count_nonzero(recording.hit))
    return [f"{n} beams without a return are left out"] if n else []


_LOGS = (".log", ".clf", ".txt", ".log.gz", ".clf.gz", ".txt.gz")
WRITERS = (
    Writer(
        "stillmap",
        "a recording folder",
        (),
        stillmap_folder.HEADER,
        _write_stillmap,
        tuple(_OPTIONAL_FIELDS),
    ),
    _bag_writer("ros2", "a ROS 2 bag folder", "", "metadata.yaml"),
    Writer("carmen", "a CARMEN log", _LOGS, "", _write_carmen, _ODOMETRY, 2, max_sensors=2),
    _bag_writer("bag", "a ROS 1 bag", ".bag"),
    _bag_writer("db3", "a ROS 2 bag file", ".db3"),
    _bag_writer("mcap", "an MCAP file", ".mcap"),
    Writer(
        "kitti",
        "a KITTI folder",
        (),
        kitti.MARKER,
        _write_kitti,
        _POSES + _ODOMETRY,
        max_sensors=1,
    ),
    Writer("pcd", "a folder of PCD files", (), pcd.MARKER, _write_pcd, _POSES, max_sensors=1),
    _cloud_writer("ply", ply.EXTENSIONS, ply.write),
    _cloud_writer("las", las.EXTENSIONS, las.write),
)
ENDINGS = ", ".join(ending for writer in WRITERS for ending in writer.endings)


def format_of_ending(path: Path) -> str | None:
    """The name of the format with the path's ending, None if there is none."""
    name = path.name.lower()
    return next((writer.name for writer in WRITERS if name.endswith(writer.endings)), None)


def find_writer(path: Path, name: str | None = None) -> Writer:
    """Find the writer of a format by its name, else by the ending of the path.

    Raises:
        InputError: no format has such a name or ending.
    """
    target = name or format_of_ending(path)
    for writer in WRITERS:
        if writer.name == target:
            return writer
    if name or path.suffix:
        what = f"no format is called or ends in {name or path.suffix!r}"
        hint = f"{ENDINGS}, or a folder without an ending"
        raise InputError(what, where=str(path), hint=hint)
    return WRITERS[0]


def require_fit(path: Path, writer: Writer, dimension: int, sensors: int) -> None:
    """Refuse recordings that a format cannot hold.

    Raises:
        InputError: it has too many dimensions or sensors.
    """
    what = f"{writer.description} cannot hold this recording"
    if dimension > writer.max_dimension:
        fault = f"{writer.max_dimension}D at most, it is {dimension}D"
        raise InputError(f"{what}: {fault}", where=str(path))
    if writer.max_sensors is not None and sensors > writer.max_sensors:
        fault = f"it has {sensors} sensors, the format holds {writer.max_sensors}"
        raise InputError(f"{what}: {fault}", where=str(path))


def write(
    recording: Recording, path: Path, *, name: str | None = None, overwrite: bool = False
) -> list[str]:
    """Write a recording in a format given by its name or by the path's ending.

    Args:
        recording: T >= 1 scans.
        path: a file or folder.
        name: of the format; None: by the ending, a recording folder where there is none.
        overwrite: replace a file, or a folder of the same format.

    Returns:
        What could not be written, a sentence each.

    Raises:
        InputError: the path is taken or cannot be written to, or the format cannot hold such a
            recording.
    """
    writer = find_writer(path, name)
    require_free(path, writer.marker, overwrite)
    if not recording.n_scans:
        raise InputError("holds no scan: there is nothing to write")
    require_fit(path, writer, recording.dimension, len(recording.T_base_sensor))
    lost = [
        f"its {words} are left out"
        for field, words in _OPTIONAL_FIELDS.items()
        if getattr(recording, field) is not None and field not in writer.fields
    ]
    try:
        return [*lost, *writer.write(recording, path, overwrite)]
    except InputError as error:
        raise InputError(error.what, where=error.where or str(path), hint=error.hint) from error


def require_free(path: Path, marker: str, overwrite: bool) -> None:
    """Refuse to overwrite anything but a file or folder of the same format.

    Raises:
        InputError: the path is taken.
    """
    if marker:
        require_new(path, marker, overwrite)
    else:
        require_new_file(path, overwrite)
