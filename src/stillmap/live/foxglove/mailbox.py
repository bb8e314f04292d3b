"""A mailbox between threads: it keeps the newest message of each kind, and no `put` waits."""

import threading
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stillmap.core.short_repr import ShortRepr
from stillmap.live.causal_labels import MapChange
from stillmap.live.foxglove.answer import Answer

_MAX_LISTS = 32  # of changes, before several of the same tile become one


@dataclass(eq=False)
class Mail(ShortRepr):
    """Messages since the mailbox was emptied.

    Attributes:
        answers: the last one of each sensor.
        changes: parts of the map, in the order in which they changed.
        resolution: m, edge of a cell of the map.
        path: (S, D) positions; None: no new ones.
        begins_anew: it is all of a new map, and what was shown before is none of it.
    """

    answers: dict[str | int, Answer] = field(default_factory=dict)
    changes: list[list[MapChange]] = field(default_factory=list)
    resolution: float = 0.0
    path: NDArray[np.float64] | None = None
    begins_anew: bool = False


class Mailbox:
    """Keeps the newest message of each kind; safe to use from several threads."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._mail, self._has_news, self._is_closed = Mail(), False, False

    def begin_anew(self) -> None:
        """Drop all: a new map begins."""
        with self._condition:
            self._mail = Mail(begins_anew=True)
            self._notify()

    def put_answer(self, answer: Answer) -> None:
        """The next scan of a sensor."""
        with self._condition:
            self._mail.answers[answer.sensor] = answer
            self._notify()

    def put_changes(self, changes: list[MapChange], resolution: float) -> None:
        """Parts of the map, for the next `take`; they alone do not end its waiting."""
        with self._condition:
            mail = self._mail
            mail.changes.append(changes)
            mail.resolution = resolution
            if len(mail.changes) > _MAX_LISTS:  # who empties it has stopped
                mail.changes = [keep_last(mail.changes)]

    def put_path(self, path: NDArray[np.float64]) -> None:
        """(S, D) positions of the robot so far."""
        with self._condition:
            self._mail.path = path
            self._notify()

    def wake(self) -> None:
        """Let `take` return, though nothing is new."""
        with self._condition:
            self._notify()

    def close(self) -> None:
        """Let `take` return None from now on."""
        with self._condition:
            self._is_closed = True
            self._notify()

    def take(self, timeout: float | None = None) -> Mail | None:
        """Wait for messages, at most `timeout` (s), and remove them; None: it is closed."""
        with self._condition:
            self._condition.wait_for(lambda: self._has_news, timeout)
            if self._is_closed:
                return None
            mail, self._mail, self._has_news = self._mail, Mail(), False
            return mail

    def _notify(self) -> None:
        self._has_news = True
        self._condition.notify()


def keep_last(changes: list[list[MapChange]]) -> list[MapChange]:
    """Each part of the map as it changed last."""
    last = {tuple(one.first_cell.tolist()): one for several in changes for one in several}
    return list(last.values())
