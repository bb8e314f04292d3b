"""What bags of all kinds have in common: channels with messages as bytes."""

from collections.abc import Iterator
from typing import NamedTuple, Protocol

from stillmap.recording.skipped import Skipped

LAST_NS = 2**63 - 1  # times of recording are counted in 64 bits


class DamagedError(Exception):
    """A bag turned out not to be whole."""


class Channel(NamedTuple):
    """One topic as one publisher wrote it.

    Attributes:
        id: within its bag.
        topic: its name.
        type: of its messages, as `sensor_msgs/msg/LaserScan`.
        encoding: `ros1` or `cdr`.
        n_messages: how many there are.
        digest: of the type's definition, "" where the bag has none.
        definition: of the type in words, "" where the bag has none.
        latched: whether who listens late still gets the last message.
    """

    id: int
    topic: str
    type: str
    encoding: str
    n_messages: int
    digest: str
    definition: str = ""
    latched: bool = False


class Message(NamedTuple):
    """One message: where it belongs, when it was recorded, and its bytes."""

    channel: Channel
    log_ns: int
    raw: bytes


class Bag(Protocol):
    """A bag that is open.

    Attributes:
        kind: for people.
        channels: what is in it.
        damage: what could not be read, by reason; numbers are byte positions.
    """

    kind: str
    channels: list[Channel]
    damage: Skipped

    def messages(self, topics: set[str], since_ns: int | None = None) -> Iterator[Message]:
        """Messages on these topics, about in the order of their recording.

        Args:
            topics: their names.
            since_ns: only those recorded then or later; None: all.

        Raises:
            DamagedError: what was taken for whole is not.
        """
        ...

    def close(self) -> None:
        """Let the files go."""
        ...
