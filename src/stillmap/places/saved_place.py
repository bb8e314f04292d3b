"""A place opened from its folder: a result of several sessions."""

import os
import shutil
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.places.inputs import is_place
from stillmap.places.plot import draw_changes, draw_trajectories
from stillmap.places.records import (
    PlaceSession,
    SessionChange,
    read_place_sessions,
    read_session_changes,
)
from stillmap.results import saved
from stillmap.results.plot import draw_dynamic
from stillmap.results.reader import SESSIONS
from stillmap.results.saved import SavedResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Source = Recording | str | os.PathLike[str] | Sequence[str | os.PathLike[str]]


@dataclass(frozen=True, eq=False, repr=False)
class SavedPlace(SavedResult):
    """A place of several sessions: poses, labels and map of all of them in one frame.

    Poses, stamps and labels are those of the sessions one after the other; a session alone, also
    its recording, is what `load_session` gives.

    Attributes:
        sessions: that were merged, accepted or not, in the order in which they were given.
        changes: what changed between sessions, in the order of time.
    """

    sessions: list[PlaceSession] = field(default_factory=list, kw_only=True)
    changes: list[SessionChange] = field(default_factory=list, kw_only=True)

    def __repr__(self) -> str:
        placed, n = sum(one.accepted for one in self.sessions), len(self.changes)
        return (
            f"<{type(self).__name__}: {placed} of {len(self.sessions)} sessions with "
            f"{len(self.stamp_ns)} scans, {n} change{'s' * (n != 1)} between them, {self.map}>"
        )

    @property
    def recording(self) -> NoReturn:
        """A place has several recordings.

        Raises:
            InputError: always; says how to get those of its sessions.
        """
        hint = "load_session(NAME).recording is that of one session"
        raise InputError("is a place of several recordings", where=str(self.path), hint=hint)

    def load_session(self, name: str, *, recording: Source | None = None) -> SavedResult:
        """One session as a result, in the frame of the place and with its map.

        Args:
            name: of an accepted session.
            recording: as of `stillmap.load`.

        Raises:
            InputError: there is no such session, or a file of it is missing or damaged.
        """
        known = [one.name for one in self.sessions if one.accepted]
        if name not in known:
            hint = f"there are {', '.join(known)}"
            raise InputError(f"has no session {name}", where=str(self.path), hint=hint)
        return saved.load(self.path / "sessions" / name, recording=recording)

    def plot(
        self,
        ax: "Axes | None" = None,
        *,
        trajectory: bool = True,
        dynamic: bool = False,
        changes: bool = True,
    ) -> "Axes":
        """Draw the map with matplotlib, in metres.

        Args:
            ax: axes to draw into; None: new ones.
            trajectory: draw the way of the robot in each session.
            dynamic: draw returns from what moves; reads the recordings of all sessions for it.
            changes: draw boxes around what changed between sessions.

        Returns:
            The axes.

        Raises:
            MissingExtra: matplotlib is not installed.
        """
        ax = super().plot(ax, trajectory=False, dynamic=False)
        if dynamic:
            for one in self.sessions:
                if one.accepted:
                    draw_dynamic(self.load_session(one.name), ax)
        if trajectory:
            draw_trajectories(self.poses, self.sessions, ax)
        if changes:
            draw_changes(self.changes, ax)
        return ax

    def _stretches(self) -> list[slice]:
        placed = [one.scans for one in self.sessions if one.accepted]
        return sorted(placed, key=lambda scans: int(scans.start))


def load(path: str | os.PathLike[str], *, recording: Source | None = None) -> SavedResult:
    """Open a folder that `stillmap map`, `stillmap merge` or `save` wrote.

    Args:
        path: the folder of a result or of a place, or `sessions/NAME` in one.
        recording: what was mapped, or where it lies now, all parts in order of time; None: where
            it was then. It is read when it is first used, say for `deskewed` or the table of beams.

    Returns:
        The result; of a place a `SavedPlace`.

    Raises:
        InputError: there is no result, or a file of it is missing or damaged.

    Examples:
        >>> result = stillmap.load("out")
        >>> result.plot()
    """
    if not is_place(Path(path)):
        return saved.load(path, recording=recording)
    if recording is not None:
        hint = "load_session(NAME, recording=PATH) says where that of one session is"
        raise InputError("is a place of several recordings", where=str(path), hint=hint)
    return load_place(Path(path))


def load_place(folder: Path) -> SavedPlace:
    """Open the folder of a place.

    Raises:
        InputError: a file of it is missing or damaged.
    """
    sessions, changes = read_place_sessions(folder), read_session_changes(folder)
    place = SavedPlace(**vars(saved.load(folder)), sessions=sessions, changes=changes)
    placed = place._stretches()
    ends = [0, *(scans.stop for scans in placed)]
    if [scans.start for scans in placed] != ends[:-1] or ends[-1] != len(place.poses):
        raise InputError(
            "is damaged: its scans are not those of the place", where=str(folder / SESSIONS)
        )
    return place


def remove_with(place: SavedPlace, folder: Path) -> None:
    """Remove a temporary folder when the place in it is no longer used."""
    weakref.finalize(place, shutil.rmtree, folder, ignore_errors=True)
