"""Static transforms for a bag that is a later part of a run, from the part that has them."""

from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

from stillmap.core.errors import InputError
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros.bag import JoinedBag, open_bag
from stillmap.io.ros.bag_types import Bag, Channel, DamagedBagError, Message

_STATIC = "tf_static"


class _Messages:
    """Messages that were read already, as a bag."""

    kind = "messages"

    def __init__(self, messages: list[Message]) -> None:
        self._messages = messages
        channels = {m.channel.id: m.channel for m in messages}
        self.channels: list[Channel] = [
            c._replace(n_messages=sum(m.channel.id == c.id for m in messages))
            for c in channels.values()
        ]
        self.damage = SkippedRecords()

    def messages(self, topics: set[str], since_ns: int | None = None) -> Iterator[Message]:
        """See `Bag`."""
        for message in self._messages:
            if message.channel.topic in topics and (since_ns is None or message.log_ns >= since_ns):
                yield message

    def close(self) -> None:
        """See `Bag`."""


def lend_transforms(bag: Bag, others: Sequence[Path], scratch: Path | None) -> Bag:
    """The bag with the static transforms of another one, where it has none of its own.

    Args:
        bag: in doubt a later part of the run.
        others: the part before is the last of these that begins before the bag, else any.
        scratch: see `open_bag`.
    """
    if _static_topics(bag):
        return bag
    start_ns = _first_log_ns(bag)
    best: list[Message] = []
    for path in others:
        found = _read_static(path, scratch)
        if found and (not best or best[0].log_ns < found[0].log_ns <= start_ns):
            best = found
    return JoinedBag([_Messages(best), bag], bag.kind) if best else bag


def _static_topics(bag: Bag) -> set[str]:
    return {c.topic for c in bag.channels if c.n_messages and c.topic.rpartition("/")[2] == _STATIC}


def _first_log_ns(bag: Bag) -> int:
    first = next(iter(bag.messages({c.topic for c in bag.channels})), None)
    return 0 if first is None else first.log_ns


def _read_static(path: Path, scratch: Path | None) -> list[Message]:
    """Static transforms of a bag; none of one that is damaged."""
    try:
        with closing(open_bag(path, scratch, trusted=True)) as bag:
            return list(bag.messages(_static_topics(bag)))
    except (DamagedBagError, InputError, OSError):
        return []  # it is reported when it is read itself
