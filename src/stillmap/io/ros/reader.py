"""Reads ROS bags as recordings, without ROS: selects topics, and collects their messages once."""

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from stillmap.core.camera import Images
from stillmap.core.errors import InputError, advise
from stillmap.core.recording import Recording
from stillmap.io.builder import ReadContext, SkippedRecords
from stillmap.io.ros.bag import bag_size, open_bag
from stillmap.io.ros.clouds import CloudCollector, read_clouds
from stillmap.io.ros.image import ImageCollector
from stillmap.io.ros.lasers import LaserCollector, read_lasers, read_tilting_laser
from stillmap.io.ros.limits import count_output, limit_output
from stillmap.io.ros.messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    ODOMETRY,
    POINT_CLOUD,
    ROS1_TF,
    SCAN_TYPES,
    TF,
    UNREADABLE,
    Bag,
    Channel,
    DamagedBagError,
    Message,
    SkippedByTopic,
    decode,
    find_fault,
    peek_stamp_ns,
)
from stillmap.io.ros.tf import Frames, Odometry, TransformTree
from stillmap.prepare.lasers import RawLasers
from stillmap.prepare.options import ReadOptions
from stillmap.prepare.time_window import TimeWindow

_STATIC = "tf_static"
_PROGRESS_INTERVAL = 2000  # messages


def read(path: Path, context: ReadContext) -> Recording | RawLasers:
    """Read a bag: ROS 1, or a file or folder of ROS 2; see `read_parts`."""
    return read_parts([path], context)


def read_parts(
    paths: Sequence[Path],
    context: ReadContext,
    others: Sequence[Path] = (),
    *,
    tilting: bool = False,
) -> Recording | RawLasers:
    """Read bags that are parts of one run as one.

    Bad messages are skipped and counted. A bag that is cut, damaged or without an index is read
    from the front as far as it goes.

    Args:
        paths: of the bags, in order of time.
        context: see ReadContext.
        others: bags that may be further parts: recorders write static transforms into the first
            part alone, so that one without any takes those of another.
        tilting: the laser tilts or pans: its scans become 3D points, by the transforms. The option
            `topic` names them, or clouds made from them; `base_frame` the robot.

    Raises:
        InputError: one cannot be read, or they hold no usable scan.
    """
    where, damage, size = str(paths[0]), "", bag_size([*paths, *others])
    for trusted in (True, False):
        reopen = partial(open_bag, paths, context.scratch, trusted=trusted)
        try:
            with limit_output(size), closing(reopen()) as bag:
                recording = _read_bag(bag, context, reopen, others, tilting)
        except DamagedBagError as error:
            damage = str(error).rstrip(".")
        except InputError as error:
            what = f"{error.what}; it is damaged: {damage}" if damage else error.what
            raise InputError(what, where=error.where or where, hint=error.hint) from error
        else:
            source = recording.source
            source.path, source.format = where, bag.kind
            if damage:
                what = f"the bag is cut or damaged ({damage}): what could be read is used"
                todo = "copy it again; if it was recorded so, the map ends where the bag does"
                source.warnings.insert(0, advise(what, todo))
            return recording
    raise InputError(f"is damaged: {damage}", where=where)


def _read_bag(
    bag: Bag,
    context: ReadContext,
    reopen: Callable[[], Bag],
    others: Sequence[Path],
    tilting: bool,
) -> Recording | RawLasers:
    topics = select_topics(bag, context.options)
    content = collect_messages(bag, topics, context)
    if others and not _static_topics(bag):
        _lend_transforms(content.transforms, others, context.scratch)
    frames = Frames(content.transforms, content.odometry)
    if topics.has_clouds:

        def find_images(base: str) -> Images | None:
            images = content.images.build_images(content.transforms, base, reopen)
            return content.window.select_images(images)

        recording: Recording | RawLasers = read_clouds(
            content.clouds, frames, context.options, find_images
        )
    else:
        read_scans = read_tilting_laser if tilting else read_lasers
        recording = read_scans(content.lasers, frames, context)
    source = recording.source
    source.topics, source.skipped_unit = topics.notes, "message"
    source.damage = bag.damage.by_reason()
    source.skipped_odometry = content.skipped_odometry.by_reason()
    source.part = content.window.part
    return recording


def _static_topics(bag: Bag) -> set[str]:
    return {c.topic for c in bag.channels if c.n_messages and c.topic.endswith(_STATIC)}


def _lend_transforms(tree: TransformTree, others: Sequence[Path], scratch: Path | None) -> None:
    """Add the static transforms of the first of several bags that has any."""
    for path in others:
        try:
            with closing(open_bag([path], scratch, trusted=True)) as bag:
                for message in bag.messages(_static_topics(bag)):
                    tree.add_message(decode(message), static=True)
                if _static_topics(bag):
                    return
        except (DamagedBagError, InputError, OSError):
            continue  # it is reported when it is read itself


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
    tilting = {f"{slash}{options.tilting_topic}" for slash in ("", "/")}
    scans = _find_named(usable, bag, options) or [c for c in usable if c.type in SCAN_TYPES]
    scans = [c for c in scans if c.topic not in tilting]
    if not scans:
        of_scans = [c for c in bag.channels if c.type in SCAN_TYPES]
        faults = [f"{c.topic} {fault}" for c in of_scans if (fault := find_fault(c))]
        faults += [f"{c.topic} is empty" for c in of_scans if not c.n_messages]
        what = f"holds no scans: {faults[0]}" if faults else "holds no scans"
        raise InputError(what, hint=_list_topics(bag.channels))
    lasers = [c for c in scans if c.type != POINT_CLOUD]
    further = {"odometry": (ODOMETRY,), "transforms": (TF, ROS1_TF)}
    if not lasers:
        further["images"] = (IMAGE, COMPRESSED_IMAGE, CAMERA_INFO)
    uses = {c.topic: use for use, types in further.items() for c in usable if c.type in types}
    uses |= dict.fromkeys((c.topic for c in lasers or scans), "scans")
    notes = [_describe_topic(c, uses.get(c.topic), tilting) for c in bag.channels]
    return TopicSelection(uses, not lasers, notes)


def _find_named(usable: list[Channel], bag: Bag, options: ReadOptions) -> list[Channel]:
    """The channels of the topics that the options name."""
    named = []
    for name in (options.topic or "").split(",") if options.topic is not None else ():
        own = [c for c in bag.channels if c.topic in (name.strip(), f"/{name.strip()}")]
        scans = [c for c in own if c in usable and c.type in SCAN_TYPES]
        if not scans:
            faults = [find_fault(c) or f"has {c.type}, no scans" for c in own if c.n_messages]
            fault = faults[0] if faults else ("is empty" if own else "is not there")
            raise InputError(f"topic {name.strip()!r} {fault}", hint=_list_topics(bag.channels))
        named += scans
    if len({c.type == POINT_CLOUD for c in named}) > 1:
        raise InputError("laser scans and point clouds cannot be used together", hint="name either")
    return named


def _list_topics(channels: list[Channel]) -> str:
    if not channels:
        return "it has no topics"
    of_scans = [c for c in channels if c.type in SCAN_TYPES and c.n_messages]
    shown = [f"{c.topic} ({c.type.rpartition('/')[2]})" for c in (of_scans or channels)[:12]]
    return f"{'topics with scans:' if of_scans else 'it has'} {', '.join(shown)}"


def _describe_topic(channel: Channel, use: str | None, tilting: set[str]) -> dict[str, Any]:
    if channel.n_messages == 0:
        why = "empty"
    elif use is not None:
        why = f"read for {use}"
    elif channel.type not in (*SCAN_TYPES, ODOMETRY, TF, ROS1_TF):
        why = "not used"
    elif channel.topic in tilting:
        why = "not for the map: its laser tilts"
    else:
        why = find_fault(channel) or "not used: others are (read.topic names it)"
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
    window: TimeWindow
    skipped: SkippedByTopic
    count: Counter[str] = field(default_factory=Counter)  # scans by topic
    images: ImageCollector = field(default_factory=ImageCollector)
    transforms: TransformTree = field(default_factory=TransformTree)
    odometry_by_topic: dict[str, Odometry] = field(default_factory=dict)
    unreadable: SkippedRecords = field(default_factory=SkippedRecords)

    @property
    def odometry(self) -> list[Odometry]:
        """The Odometry topics with at least one pose."""
        return [topic for topic in self.odometry_by_topic.values() if len(topic.stamp_ns)]

    @property
    def skipped_odometry(self) -> SkippedRecords:
        """Transforms and poses that could not be used."""
        of_topics = (topic.skipped for topic in self.odometry_by_topic.values())
        return self.unreadable.merge(self.transforms.skipped, *of_topics)

    def add(self, message: Message, use: str | None, number: int) -> None:
        """Add a message; scans and images outside the time window are not decoded."""
        topic = message.channel.topic
        if use == "scans":
            self.count[topic] += 1
            stamp = peek_stamp_ns(message) if self.window else None
            if stamp is None or self.window.select(stamp):
                self._add_scan(message)
        elif use == "images":
            # one CameraInfo holds for all images
            whole = not self.window or message.channel.type == CAMERA_INFO
            stamp = None if whole else peek_stamp_ns(message)
            if stamp is None or self.window.contains(stamp):
                self.images.add_message(message)
        else:
            try:
                self._add_pose(message, use)
            except Exception:  # any error of rosbags about damaged bytes
                self.unreadable.add(f"{UNREADABLE} ({topic})", number)

    def _add_scan(self, message: Message) -> None:
        topic = message.channel.topic
        scans = self.clouds if message.channel.type == POINT_CLOUD else self.lasers
        try:
            fault = scans.add(message, self.count[topic])
        except OSError:  # the disk is full
            raise
        except Exception:  # any error of rosbags about damaged bytes
            fault = UNREADABLE
        if fault is not None:
            self.skipped[topic].add(fault, self.count[topic])

    def _add_pose(self, message: Message, use: str | None) -> None:
        topic = message.channel.topic
        if use == "transforms":
            static = topic.endswith(_STATIC)
            self.transforms.add_message(decode(message), static=static)
        elif use == "odometry":
            odometry = self.odometry_by_topic.setdefault(topic, Odometry(topic))
            odometry.add_message(decode(message))
        else:  # of a damaged bag whose connections have the number of others
            raise ValueError(topic)


def collect_messages(bag: Bag, selection: TopicSelection, context: ReadContext) -> BagContent:
    """Read the selected topics.

    Raises:
        DamagedBagError: an indexed bag is damaged.
        InputError: no scan lies in the window.
    """
    window, skipped = TimeWindow(context.options), SkippedByTopic(SkippedRecords)
    collectors = (
        LaserCollector(context.scratch, skipped),
        CloudCollector(context.scratch, skipped),
    )
    content = BagContent(*collectors, window, skipped)
    total = sum(c.n_messages for c in bag.channels if c.topic in selection.uses)
    for number, message in enumerate(bag.messages(set(selection.uses)), start=1):
        count_output(len(message.raw))
        content.add(message, selection.uses.get(message.channel.topic), number)
        if context.progress is not None and number % _PROGRESS_INTERVAL == 0:
            context.progress(min(number / max(total, 1), 1.0))
    window.require_scans()
    return content
