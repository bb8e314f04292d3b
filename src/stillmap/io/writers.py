"""The table of formats that are written (`WRITERS`).

The table of formats that are read is in `registry.py`.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stillmap.core.errors import InputError
from stillmap.core.files import require_new, require_new_file
from stillmap.core.recording import Recording
from stillmap.io import stillmap_folder
from stillmap.io.point_cloud import kitti, las, pcd, ply
from stillmap.io.point_cloud.clouds import describe_non_returns, place_clouds
from stillmap.io.registry import LOGS, load_later

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
    fields: tuple[str, ...] = _ODOMETRY
    max_dimension: int = 3
    max_sensors: int | None = None


def _write_cloud(
    write: Callable[..., None], recording: Recording, path: Path, _: bool
) -> list[str]:
    """Write all scans as one point cloud, by the poses that the recording has."""
    T, losses = recording.T_recorded_base, []
    if T is None:
        T, losses = recording.T_odom_base, ["the cloud is placed by odometry: maps are better"]
    if T is None:
        T = np.tile(np.eye(recording.dimension + 1), (recording.n_scans, 1, 1))
        losses = ["there are no poses: all scans lie at one place"] if len(T) > 1 else []
    write(recording, path, place_clouds(recording, T))
    return [*losses, *describe_non_returns(recording)]


_HEADER, _ALL = stillmap_folder.HEADER, tuple(_OPTIONAL_FIELDS)
_PLACED = _POSES + _ODOMETRY
_LOG, _BAG = load_later("carmen.writer", "write_log"), load_later("ros.writer", "write_recording")
_PLY, _LAS = partial(_write_cloud, ply.write), partial(_write_cloud, las.write)
WRITERS = (
    Writer("stillmap", "a recording folder", (), _HEADER, stillmap_folder.write, _ALL),
    Writer("ros2", "a ROS 2 bag folder", (), "metadata.yaml", partial(_BAG, "ros2")),
    Writer("carmen", "a CARMEN log", LOGS, "", _LOG, _ODOMETRY, 2, 2),
    Writer("bag", "a ROS 1 bag", (".bag",), "", partial(_BAG, "bag")),
    Writer("db3", "a ROS 2 bag file", (".db3",), "", partial(_BAG, "db3")),
    Writer("mcap", "an MCAP file", (".mcap",), "", partial(_BAG, "mcap")),
    Writer("kitti", "a KITTI folder", (), kitti.MARKER, kitti.write, _PLACED, max_sensors=1),
    Writer("pcd", "a folder of PCD files", (), pcd.MARKER, pcd.write, _POSES, max_sensors=1),
    Writer("ply", "a PLY file", ply.EXTENSIONS, "", _PLY, _PLACED),
    Writer("las", "a LAS file", las.EXTENSIONS, "", _LAS, _PLACED),
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
