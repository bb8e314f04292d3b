"""`stillmap live --foxglove`: what a live mapper answers, served by a process of its own.

Not in a thread: messages are made in Python, and a map of a large building would hold its lock for
longer than a scan may take.
"""

import json
import logging
import time
from collections.abc import Iterator

import numpy as np

from stillmap.core.errors import InputError, MissingExtra
from stillmap.live.child_process import ChildProcess
from stillmap.live.foxglove.answer import Answer, pack_answer, pack_changes, to_answer
from stillmap.live.foxglove.mailbox import Mail, Mailbox, keep_last
from stillmap.live.mapper import LiveMapper
from stillmap.live.messages import Arrays
from stillmap.live.scan import ScanBeams
from stillmap.live.update import Update

HOST, PORT = "127.0.0.1", 8765

_log = logging.getLogger(__name__)

_SLOW_PERIOD = 1.0  # s between two paths, and between two scans where nobody looks
_FAST_PERIOD = 0.02  # s at least between two scans: nobody sees more
_TILES_PER_MESSAGE = 64


class FoxgloveServer:
    """Serves map, labelled scans, movers, pose, path and doubts to Foxglove and Lichtblick.

    Args:
        host: address to listen at; who reaches it can watch.
        port: 0: any free one.

    Raises:
        InputError: foxglove-sdk is missing, the port is taken, or the host is none of this machine.
    """

    def __init__(self, host: str = HOST, port: int = PORT) -> None:
        self._process = ChildProcess("stillmap.live.foxglove.process", host, str(port))
        self._mailbox, self._is_watched, self._is_closing = Mailbox(), False, False
        self._slow_due = 0.0
        self._mapper: LiveMapper | None = None
        self._last = dict[str | int, Answer]()  # of each sensor, for who comes while none arrives
        try:
            self.url = f"ws://{_in_url(host)}:{self._read_port()}"
        except BaseException:
            self.close()
            raise
        self._process.start(self._send, self._listen)

    @property
    def is_watched(self) -> bool:
        """True if anybody has subscribed to anything."""
        return self._is_watched

    @property
    def process_id(self) -> int:
        """Of the process that serves."""
        return self._process.id

    def show(self, mapper: LiveMapper, beams: ScanBeams, update: Update) -> None:
        """Show what the mapper answered to a scan. Never waits: what nobody takes is dropped.

        Args:
            mapper: which is not pushed to meanwhile; with another one a new map begins.
            beams: the scan.
            update: the answer.
        """
        if self._mapper is not None and mapper is not self._mapper:
            self._last = {}
            self._mailbox.begin_anew()
        self._mapper = mapper
        if update.changes:
            self._mailbox.put_changes(update.changes, mapper.resolution)
        now, answer = time.monotonic(), to_answer(beams, update)
        is_first, self._last[beams.sensor] = beams.sensor not in self._last, answer
        if now >= self._slow_due:
            self._slow_due = now + _SLOW_PERIOD
            D = len(update.pose) - 1
            self._mailbox.put_path(mapper.path[:, :D, D])
            self._mailbox.put_answer(answer)
        elif self._is_watched or is_first:
            self._mailbox.put_answer(answer)

    def close(self) -> None:
        """End the process."""
        self._is_closing = True
        self._mailbox.close()
        self._process.stop()

    def __enter__(self) -> "FoxgloveServer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read_port(self) -> int:
        """The port, as soon as the process listens."""
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError("the process that serves the live view has ended")
        told = json.loads(line)
        if "port" not in told:
            kind = MissingExtra if told.pop("is_missing") else InputError
            raise kind(told.pop("what"), **told)
        return int(told["port"])

    def _send(self) -> None:
        """Write what is in the mailbox until it is closed."""
        self._process.send(self._messages())

    def _messages(self) -> Iterator[Arrays]:
        while (mail := self._mailbox.take()) is not None:
            yield from _to_messages(mail)
            time.sleep(_FAST_PERIOD)

    def _listen(self) -> None:
        """Note whether anybody looks, until the process ends."""
        for line in self._process.stdout:
            self._is_watched = bool(json.loads(line)["is_watched"])
            for answer in list(self._last.values()) if self._is_watched else []:
                self._mailbox.put_answer(answer)
        self._is_watched = False
        if not self._is_closing:
            _log.warning("the process that serves the live view has ended; mapping goes on")


def _to_messages(mail: Mail) -> Iterator[Arrays]:
    if mail.begins_anew:
        yield {"begins_anew": np.array(1)}
    changes = keep_last(mail.changes)
    for first in range(0, len(changes), _TILES_PER_MESSAGE):
        yield pack_changes(changes[first : first + _TILES_PER_MESSAGE], mail.resolution)
    if mail.path is not None:
        yield {"path": mail.path}
    for answer in mail.answers.values():
        yield pack_answer(answer)


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host
