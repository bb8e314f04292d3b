"""One pass through a bag: every message goes where it belongs."""

from dataclasses import dataclass, field
from pathlib import Path

from stillmap.io.builder import SkippedRecords
from stillmap.io.ros.bag_types import Bag, Message
from stillmap.io.ros.base_frame import Odometry
from stillmap.io.ros.image import ImageCollector
from stillmap.io.ros.laser_scan import LaserCollector
from stillmap.io.ros.limits import count_output
from stillmap.io.ros.messages import decode
from stillmap.io.ros.point_cloud2 import CloudCollector
from stillmap.io.ros.tf import TransformTree
from stillmap.io.ros.topics import TopicSelection
from stillmap.io.text_lines import Progress
from stillmap.preprocessing.options import ReadOptions

_UNREADABLE = "message that cannot be decoded"
_TELL_EVERY = 2000  # messages


@dataclass
class BagContent:
    """What the chosen topics hold."""

    lasers: LaserCollector
    clouds: CloudCollector
    images: ImageCollector
    transforms: TransformTree = field(default_factory=TransformTree)
    odometry_by_topic: dict[str, Odometry] = field(default_factory=dict)
    unreadable: SkippedRecords = field(default_factory=SkippedRecords)

    @property
    def odometry(self) -> list[Odometry]:
        """The Odometry topics that say anything."""
        return [one for one in self.odometry_by_topic.values() if len(one.stamp_ns)]

    @property
    def skipped_odometry(self) -> SkippedRecords:
        """Transforms and poses that could not be used."""
        return self.unreadable.merge(
            self.transforms.skipped, *(one.skipped for one in self.odometry_by_topic.values())
        )


def collect_messages(
    bag: Bag,
    chosen: TopicSelection,
    options: ReadOptions,
    progress: Progress | None,
    scratch: Path | None,
) -> BagContent:
    """Read everything that was chosen.

    Raises:
        DamagedError: the bag is not whole.
    """
    found = BagContent(LaserCollector(scratch), CloudCollector(options, scratch), ImageCollector())
    total = sum(c.n_messages for c in bag.channels if c.topic in chosen.all)
    for number, message in enumerate(bag.messages(chosen.all), start=1):
        topic = message.channel.topic
        count_output(len(message.raw))
        if topic in chosen.lasers:
            found.lasers.add(message)
        elif topic in chosen.clouds:
            found.clouds.add(message)
        elif topic in chosen.images:
            found.images.add(message)
        else:
            _add_pose(found, message, chosen, number)
        if progress is not None and number % _TELL_EVERY == 0:
            progress(min(number / max(total, 1), 1.0))
    return found


def _add_pose(found: BagContent, message: Message, chosen: TopicSelection, number: int) -> None:
    topic = message.channel.topic
    try:
        if topic in chosen.tf:
            static = topic.rpartition("/")[2] == "tf_static"
            found.transforms.add_message(decode(message), static=static)
        else:
            found.odometry_by_topic.setdefault(topic, Odometry(topic)).add(decode(message))
    except Exception:  # whatever the library makes of damaged bytes
        found.unreadable.add(f"{_UNREADABLE} ({topic})", number)
