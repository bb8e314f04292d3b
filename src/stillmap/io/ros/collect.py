"""One pass through a bag: every message goes where it belongs."""

from dataclasses import dataclass, field
from pathlib import Path

from stillmap.io.builder import Skipped
from stillmap.io.ros.bag_types import Bag, Message
from stillmap.io.ros.base_frame import Odometry
from stillmap.io.ros.image import Pictures
from stillmap.io.ros.laser_scan import LaserTopics
from stillmap.io.ros.limits import charge
from stillmap.io.ros.messages import decoded
from stillmap.io.ros.point_cloud2 import CloudTopics
from stillmap.io.ros.tf import Transforms
from stillmap.io.ros.topics import Chosen
from stillmap.io.text_lines import Progress
from stillmap.preprocessing.options import ReadOptions

_UNREADABLE = "message that cannot be decoded"
_TELL_EVERY = 2000  # messages


@dataclass
class Content:
    """What the chosen topics hold."""

    lasers: LaserTopics
    clouds: CloudTopics
    pictures: Pictures
    transforms: Transforms = field(default_factory=Transforms)
    by_topic: dict[str, Odometry] = field(default_factory=dict)
    unreadable: Skipped = field(default_factory=Skipped)

    @property
    def odometry(self) -> list[Odometry]:
        """The Odometry topics that say anything."""
        return [one for one in self.by_topic.values() if len(one.stamp_ns)]

    @property
    def skipped_odometry(self) -> Skipped:
        """Transforms and poses that could not be used."""
        return self.unreadable.merged(
            self.transforms.skipped, *(one.skipped for one in self.by_topic.values())
        )


def content(
    bag: Bag,
    chosen: Chosen,
    options: ReadOptions,
    progress: Progress | None,
    scratch: Path | None,
) -> Content:
    """Read everything that was chosen.

    Raises:
        DamagedError: the bag is not whole.
    """
    found = Content(LaserTopics(scratch), CloudTopics(options, scratch), Pictures())
    total = sum(c.n_messages for c in bag.channels if c.topic in chosen.all)
    for number, message in enumerate(bag.messages(chosen.all), start=1):
        topic = message.channel.topic
        charge(len(message.raw))
        if topic in chosen.lasers:
            found.lasers.add(message)
        elif topic in chosen.clouds:
            found.clouds.add(message)
        elif topic in chosen.images:
            found.pictures.add(message)
        else:
            _add_pose(found, message, chosen, number)
        if progress is not None and number % _TELL_EVERY == 0:
            progress(min(number / max(total, 1), 1.0))
    return found


def _add_pose(found: Content, message: Message, chosen: Chosen, number: int) -> None:
    topic = message.channel.topic
    try:
        if topic in chosen.tf:
            static = topic.rpartition("/")[2] == "tf_static"
            found.transforms.add(decoded(message), static=static)
        else:
            found.by_topic.setdefault(topic, Odometry(topic)).add(decoded(message))
    except Exception:  # whatever the library makes of damaged bytes
        found.unreadable.add(f"{_UNREADABLE} ({topic})", number)
