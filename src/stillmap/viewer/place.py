"""A place for the viewer: the scans of its sessions, and the map as of each."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stillmap.core.grid_map import GridMap
from stillmap.io.trajectory import read_tum
from stillmap.results.report.place import PlacePictures
from stillmap.results.timeline import Timeline, read_timeline

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ViewedPlace:
    """A place of S sessions in the order of time.

    Attributes:
        timeline: what changed between them.
        first_scan: (S + 1,) session s has the scans first_scan[s]:first_scan[s + 1] of the scene.
        pictures: of the map; None for an empty one.
    """

    timeline: Timeline
    first_scan: NDArray[np.intp]
    pictures: PlacePictures | None

    def __len__(self) -> int:
        return len(self.timeline.sessions)

    def scans_of(self, session: int) -> range:
        """Indices of the scans of a session in the scene."""
        return range(int(self.first_scan[session]), int(self.first_scan[session + 1]))

    def name_of(self, session: int) -> str:
        """The name of a session."""
        return self.timeline.sessions[session].name

    def draw_map(self, session: int) -> Image.Image | None:
        """The map as of a session, in color what came and left since the one before."""
        return None if self.pictures is None else self.pictures.draw(session)


def read_viewed_place(folder: Path, grid: GridMap) -> tuple[ViewedPlace, NDArray[np.int64], Float]:
    """The sessions of a place, and stamps (T,) and poses (T, 4, 4) of all their scans.

    Args:
        folder: of the place.
        grid: its map.

    Raises:
        InputError: a file is missing or damaged.
    """
    timeline = read_timeline(folder)
    homes = [folder / "sessions" / one.name for one in timeline.sessions]
    trajectories = [read_tum(home / "trajectory.tum") for home in homes]
    stamp_ns, poses = (np.concatenate(part) for part in zip(*trajectories, strict=True))
    first_scan = np.cumsum([0, *(len(stamps) for stamps, _ in trajectories)])
    pictures = PlacePictures(grid, timeline) if grid.p_occupied.size else None
    return ViewedPlace(timeline, first_scan, pictures), stamp_ns, poses
