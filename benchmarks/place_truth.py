"""The truth about simulated sessions, as scores read it."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from session_overlap import compute_overlap, observe

from stillmap.core.array_types import Float
from stillmap.core.errors import InputError
from stillmap.core.json import read_json
from stillmap.io import stillmap_folder
from stillmap.sim.session_layout import ObjectKind, Place, StandingObject
from stillmap.sim.sessions import SESSIONS_FILE, TrueChange
from stillmap.sim.truth import Truth, load_truth

_MAX_BYTES = 64 << 20


@dataclass(frozen=True, eq=False)
class SessionTruth:
    """The truth about S sessions.

    Attributes:
        folder: of the sessions.
        names: of their folders in it.
        place: (S,) number of the place that each was recorded in; most often all in one.
        T_world_session: (S, D+1, D+1) first pose of the robot in each.
        objects: everything that may stand otherwise, with its places.
        changes: between successive sessions, in order.
    """

    folder: Path
    names: tuple[str, ...]
    place: NDArray[np.int64]
    T_world_session: Float
    objects: tuple[StandingObject, ...]
    changes: tuple[TrueChange, ...]

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return int(self.T_world_session.shape[-1]) - 1

    @cached_property
    def overlap(self) -> Float:
        """(S, S) share of the static hits of session j in cells that session i observed."""
        sights = [
            observe(stillmap_folder.read(self.folder / name), self.beams(session))
            for session, name in enumerate(self.names)
        ]
        return compute_overlap(sights, self.place.tolist())

    def beams(self, session: int) -> Truth:
        """The truth about the beams of a session; `thing` is an index of `objects`.

        Raises:
            InputError: it is missing or damaged.
        """
        return load_truth(self.folder / self.names[session])

    def changed_beams(self, session: int) -> NDArray[np.int32]:
        """(M,) index of the object, not the same in all sessions, that each beam hit, or -1.

        Raises:
            InputError: the truth is missing or damaged.
        """
        truth = self.beams(session)
        if truth.thing is None:
            return np.full(len(truth.mover), -1, np.int32)
        changed = np.array([one.is_changed for one in self.objects] + [False])
        return np.where(changed[truth.thing], truth.thing, np.int32(-1))

    def faces(self, session: int, only: NDArray[np.bool_] | None = None) -> Float:
        """(K, 4) faces of the objects that stand there in a session; `only` some (O,) of them."""
        some = [item for k, item in enumerate(self.objects) if only is None or only[k]]
        return np.concatenate([np.empty((0, 4)), *(item.faces_in(session) for item in some)])


def load_session_truth(folder: str | Path) -> SessionTruth:
    """Load the truth that `stillmap simulate --sessions` wrote.

    Raises:
        InputError: there is none, or it is damaged.
    """
    path = Path(folder) / SESSIONS_FILE
    if not path.is_file():
        hint = "a folder of sessions that 'stillmap simulate' wrote"
        raise InputError("holds no truth about sessions", where=str(folder), hint=hint)
    tree = read_json(path, _MAX_BYTES)
    try:
        return _parse(Path(folder), tree)
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError) as error:
        raise InputError(f"is damaged: {error!r}", where=str(path)) from error


def _parse(folder: Path, tree: dict[str, Any]) -> SessionTruth:
    names = [str(one["name"]) for one in tree["sessions"]]
    if any(Path(name).name != name for name in names):
        raise ValueError("a session's name is a path")
    at = {name: number for number, name in enumerate(names)}
    objects = tuple(_parse_object(one) for one in tree["objects"])
    changes = tuple(
        TrueChange(
            int(one["object"]),
            str(one["kind"]),
            tuple(map(float, one["box"])),
            tuple(map(float, one["from_box"])) if "from_box" in one else None,
            (at[one["between"][0]], at[one["between"][1]]),
        )
        for one in tree["changes"]
    )
    return SessionTruth(
        folder,
        tuple(names),
        np.array([one["place"] for one in tree["sessions"]], np.int64),
        np.array([one["T_world_session"] for one in tree["sessions"]], np.float64),
        objects,
        changes,
    )


def _parse_object(tree: dict[str, Any]) -> StandingObject:
    kind: ObjectKind = tree["kind"]
    faces = tuple((float(a), float(b), float(c), float(d)) for a, b, c, d in tree["faces"])
    places = [None if at is None else Place(*map(float, at)) for at in tree["at"]]
    return StandingObject(kind, faces, places)
