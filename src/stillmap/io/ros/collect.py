"""Selects the topics of a bag that make a recording, and collects their messages in one pass."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

from stillmap.core.errors import InputError
from stillmap.io.builder import ReadContext, SkippedRecords
from stillmap.io.ros.bag_types import Bag, Channel, Message
from stillmap.io.ros.image import ImageCollector
from stillmap.io.ros.laser_scan import UNREADABLE, LaserCollector
from stillmap.io.ros.limits import count_output
from stillmap.io.ros.messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    LASER_SCAN,
    MULTI_ECHO,
    ODOMETRY,
    POINT_CLOUD,
    ROS1_TF,
    TF,
    decode,
    find_fault,
    peek_stamp_ns,
)
from stillmap.io.ros.point_cloud2 import CloudCollector
from stillmap.io.ros.tf import Odometry, TransformTree
from stillmap.prepare.options import ReadOptions
from stillmap.prepare.time_window import TimeWindow

_SCAN_TYPES = (LASER_SCAN, MULTI_ECHO, POINT_CLOUD)
_PROGRESS_INTERVAL = 2000  # messages


class TopicSelection(NamedTuple):
    """Topics by their use.

    Attributes:
        uses: "scans", "images", "transforms" or "odometry", by topic.
        has_clouds: whether scans are point clouds.
        notes: type, number of messages and use of every topic of the bag.
    """

    uses: dict[str, str]
    has_clouds: bool
    notes: list[dict[str, Any]]


def select_topics(bag: Bag, options: ReadOptions) -> TopicSelection:
    """Select the topics to read: laser scans, else point clouds, and what belongs to them.

    Raises:
        InputError: no topic has scans, or a topic that the options name has none.
    """
    usable = [c for c in bag.channels if c.n_messages and find_fault(c) is None]
    name = options.tilting_topic
    tilting = set() if name is None else {name, f"/{name}"}
    scans = _find_named(usable, bag, options) or [c for c in usable if c.type in _SCAN_TYPES]
    scans = [c for c in scans if c.topic not in tilting]
    if not scans:
        raise InputError(_describe_lack_of_scans(bag.channels), hint=_list_topics(bag.channels))
    lasers = [c for c in scans if c.type != POINT_CLOUD]
    further = {"odometry": (ODOMETRY,), "transforms": (TF, ROS1_TF)}
    if not lasers:
        further["images"] = (IMAGE, COMPRESSED_IMAGE, CAMERA_INFO)
    uses = {c.topic: use for use, types in further.items() for c in usable if c.type in types}
    uses |= dict.fromkeys((c.topic for c in lasers or scans), "scans")
    notes = [_describe_topic(c, uses.get(c.topic), tilting) for c in bag.channels]
    return TopicSelection(uses, not lasers, notes)


def _find_named(usable: list[Channel], bag: Bag, options: ReadOptions) -> list[Channel]:
    if options.topic is None:
        return []
    found = []
    for name in (part.strip() for part in options.topic.split(",")):
        of_name = [c for c in bag.channels if c.topic in (name, f"/{name}")]
        scans = [c for c in of_name if c in usable and c.type in _SCAN_TYPES]
        if not scans:
            faults = [find_fault(c) or f"has {c.type}, no scans" for c in of_name if c.n_messages]
            fault = faults[0] if faults else ("is empty" if of_name else "is not there")
            raise InputError(f"topic {name!r} {fault}", hint=_list_topics(bag.channels))
        found += scans
    if len({c.type == POINT_CLOUD for c in found}) > 1:
        raise InputError("laser scans and point clouds cannot be used together", hint="name either")
    return found


def _describe_lack_of_scans(channels: list[Channel]) -> str:
    of_scans = [c for c in channels if c.type in _SCAN_TYPES]
    for channel in of_scans:
        if fault := find_fault(channel):
            return f"holds no scans that can be read: {channel.topic} {fault}"
    empty = [c.topic for c in of_scans if not c.n_messages]
    return f"holds no scans: {empty[0]} is empty" if empty else "holds no scans"


def _list_topics(channels: list[Channel]) -> str:
    if not channels:
        return "it has no topics"
    of_scans = [c for c in channels if c.type in _SCAN_TYPES and c.n_messages]
    listed = ", ".join(
        f"{c.topic} ({c.type.rpartition('/')[2]})" for c in (of_scans or channels)[:12]
    )
    return f"topics with scans: {listed}" if of_scans else f"it has {listed}"


def _describe_topic(channel: Channel, use: str | None, tilting: set[str]) -> dict[str, Any]:
    is_relevant = channel.type in (*_SCAN_TYPES, ODOMETRY, TF, ROS1_TF)
    fault = find_fault(channel) if is_relevant else None
    if channel.n_messages == 0:
        why = "empty"
    elif use is not None:
        why = f"read for {use}"
    elif fault:
        why = fault
    elif channel.topic in tilting:
        why = "not for the map: its laser tilts"
    elif channel.type == POINT_CLOUD:
        why = "not used: the laser scans are (name it to use it instead)"
    elif channel.type in _SCAN_TYPES:
        why = "not used: others are named"
    else:
        why = "not used"
    return {
        "topic": channel.topic,
        "type": channel.type,
        "messages": channel.n_messages,
        "used": use is not None,
        "why": why,
    }


@dataclass
class BagContent:
    """The content of the selected topics."""

    lasers: LaserCollector
    clouds: CloudCollector
    images: ImageCollector
    window: TimeWindow
    transforms: TransformTree = field(default_factory=TransformTree)
    odometry_by_topic: dict[str, Odometry] = field(default_factory=dict)
    unreadable: SkippedRecords = field(default_factory=SkippedRecords)

    @property
    def odometry(self) -> list[Odometry]:
        """The Odometry topics with at least one pose."""
        return [one for one in self.odometry_by_topic.values() if len(one.stamp_ns)]

    @property
    def skipped_odometry(self) -> SkippedRecords:
        """Transforms and poses that could not be used."""
        return self.unreadable.merge(
            self.transforms.skipped, *(one.skipped for one in self.odometry_by_topic.values())
        )


def collect_messages(bag: Bag, selection: TopicSelection, context: ReadContext) -> BagContent:
    """Read the selected topics; scans and images outside the time window are not decoded.

    Raises:
        DamagedBagError: an indexed bag is damaged.
        InputError: no scan lies in the window.
    """
    window = TimeWindow(context.options)
    lasers, clouds = LaserCollector(context.scratch), CloudCollector(context)
    content = BagContent(lasers, clouds, ImageCollector(), window)
    scans = content.clouds if selection.has_clouds else content.lasers
    total = sum(c.n_messages for c in bag.channels if c.topic in selection.uses)
    for number, message in enumerate(bag.messages(set(selection.uses)), start=1):
        use = selection.uses.get(message.channel.topic)
        count_output(len(message.raw))
        if use is None:  # of a damaged bag whose connections have the number of others
            content.unreadable.add(f"{UNREADABLE} ({message.channel.topic})", number)
        elif use == "scans":
            scans.add_message(message, skip=bool(window) and not _is_in_window(message, window))
        elif use == "images":
            if not window or _is_image_in_window(message, window):
                content.images.add_message(message)
        else:
            _add_pose(content, message, use, number)
        if context.progress is not None and number % _PROGRESS_INTERVAL == 0:
            context.progress(min(number / max(total, 1), 1.0))
    window.require_scans()
    return content


def _is_in_window(message: Message, window: TimeWindow) -> bool:
    stamp = peek_stamp_ns(message)
    return stamp is None or window.select(stamp)  # what cannot be decoded is counted as damage


def _is_image_in_window(message: Message, window: TimeWindow) -> bool:
    if message.channel.type == CAMERA_INFO:  # one holds for all images
        return True
    stamp = peek_stamp_ns(message)
    return stamp is None or window.contains(stamp)


def _add_pose(content: BagContent, message: Message, use: str, number: int) -> None:
    topic = message.channel.topic
    try:
        if use == "transforms":
            static = topic.rpartition("/")[2] == "tf_static"
            content.transforms.add_message(decode(message), static=static)
        else:
            odometry = content.odometry_by_topic.setdefault(topic, Odometry(topic))
            odometry.add_message(decode(message))
    except Exception:  # any error of rosbags about damaged bytes
        content.unreadable.add(f"{UNREADABLE} ({topic})", number)
