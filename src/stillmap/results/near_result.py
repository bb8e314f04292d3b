"""A result as it is read into a frame near the robot, in which others go on from it."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stillmap.core import se2
from stillmap.core.array_folder import open_npy
from stillmap.core.array_types import Float
from stillmap.core.errors import InputError
from stillmap.core.local_frame import FAR, Shift, find_origin, shift, shift_poses
from stillmap.core.short_repr import ShortRepr
from stillmap.io.trajectory import is_rigid, read_tum
from stillmap.pipeline.map_frame import FIELDS
from stillmap.results.folder import ResultFolder
from stillmap.results.point_cloud import Block, cloud_from_folder
from stillmap.results.pose_graph_g2o import read_g2o
from stillmap.results.reader import RECORD, Grid, read_grid, read_run
from stillmap.slam import PoseGraph

ROUTE = "live/known_route.npy"  # of a result that extends a map, from where that one was made
MAX_DISTANCE = 1e6  # m, of poses from the origin of their frame: no place is larger


@dataclass(frozen=True, eq=False)
class NearResult(ShortRepr):
    """The folder of a result or a place, all of it in a frame near the robot.

    Attributes:
        folder: of the result.
        origin: (3,) m, of the frame, in the map frame of the result.
    """

    folder: Path
    origin: Float

    @classmethod
    def find(cls, folder: Path, poses: Float) -> "NearResult":
        """The frame in which a result was computed, with whose cells those of its map agree; where
        its record states none, near some poses (T, D+1, D+1).

        Raises:
            InputError: its record is damaged.
        """
        noted = np.zeros(3)
        if (folder / RECORD).is_file():
            noted = ResultFolder(folder, read_run(folder)).read_origin()
        near = cls(folder, noted if noted.any() else find_origin(poses, FAR))
        if not (np.abs(near.take(poses)) < MAX_DISTANCE).all():
            where = str(folder / RECORD)
            raise InputError("local_origin is far from its trajectory", where=where)
        return near

    @classmethod
    def open_map(cls, folder: Path) -> tuple["NearResult", Grid]:
        """The result and its map.

        Raises:
            InputError: it has none, or its record is damaged.
        """
        grid = read_grid(folder)
        near = cls.find(folder, se2.matrix(*grid.origin)[None])
        return near, shift(grid, Shift(-near.origin), FIELDS)

    def take(self, poses: Float) -> Float:
        """Poses (T, D+1, D+1) T_map_base of the result in its frame."""
        return shift_poses(poses, -self.origin)

    def read_graph(self) -> PoseGraph | None:
        """The pose graph; None: there is none.

        Raises:
            InputError: it is damaged.
        """
        path = self.folder / "graph.g2o"
        return shift(read_g2o(path), Shift(-self.origin), FIELDS) if path.is_file() else None

    def read_route(self) -> Float:
        """(T, 4, 4) poses of a result and of a map that it extends, or of all sessions of a place.

        Raises:
            InputError: there is none, or it is damaged.
        """
        single, extended = self.folder / "trajectory.tum", self.folder / ROUTE
        every = sorted(self.folder.glob("sessions/*/trajectory.tum"))
        poses = [read_tum(path)[1] for path in ([single] if single.exists() else every)]
        if extended.exists():
            route = open_npy(extended)
            if route.dtype != np.float64 or route.shape[1:] != (4, 4) or not is_rigid(route).all():
                raise InputError("holds no poses", where=str(extended))
            poses.append(route)
        if not sum(map(len, poses)):
            raise InputError("holds no trajectory", where=str(self.folder))
        return self.take(np.concatenate(poses))

    def iter_points(self) -> Iterator[Block]:
        """The static points, block by block.

        Raises:
            InputError: they are damaged.
        """
        for block in cloud_from_folder(self.folder, "static").iter_blocks():
            yield block._replace(points=block.points - self.origin)
