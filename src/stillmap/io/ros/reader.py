"""Reads ROS bags as recordings, without ROS: selects topics, and collects their messages once."""

from collections import Counter
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from stillmap.core.camera import Images
from stillmap.core.errors import InputError, advise
from stillmap.core.recording import Recording
from stillmap.io.builder import ReadContext, SkippedRecords
from stillmap.io.ros import messages
from stillmap.io.ros.bag import Bag, read_bag
from stillmap.io.ros.clouds import CloudCollector, read_clouds
from stillmap.io.ros.image import ImageCollector
from stillmap.io.ros.lasers import LaserCollector, read_lasers
from stillmap.io.ros.limits import count_output
from stillmap.io.ros.tf import Odometry, TransformTree
from stillmap.prepare.lasers import RawLasers
from stillmap.prepare.options import ReadOptions
from stillmap.prepare.time_window import TimeWindow

_STATIC = "tf_static"
_PROGRESS_INTERVAL = 2000  # messages


def read(
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

    def use(bag: Bag) -> Recording | RawLasers:
        return _read_content(bag, context, others, tilting)

    recording, damage = read_bag(paths, context.scratch, use, others)
    source, source.path = recording.source, str(paths[0])
    if damage:
        what = f"the bag is cut or damaged ({damage}): what could be read is used"
        todo = "copy it again; if it was recorded so, the map ends where the bag does"
        source.warnings.insert(0, advise(what, todo))
    return recording


def _read_content(
    bag: Bag, context: ReadContext, others: Sequence[Path], tilting: bool
) -> Recording | RawLasers:
    uses, notes = select_topics(bag, context.options)
    content = collect_messages(bag, uses, context)
    tree, window = content.transforms, content.window
    if others and not _static_topics(bag):
        _lend_transforms(tree, others, context.scratch)
    tree.odometry = {name: own for name, own in content.odometry.items() if len(own.stamp_ns)}
    recording: Recording | RawLasers
    if any(c.type == messages.POINT_CLOUD and uses.get(c.topic) == "scans" for c in bag.channels):

        def find_images(base: str) -> Images | None:
            return window.select_images(content.images.build_images(tree, base, bag.reopen))

        recording = read_clouds(content.clouds, tree, context.options, find_images)
    else:
        recording = read_lasers(content.lasers, tree, context, tilting=tilting)
    source, of_odometry = recording.source, [own.skipped for own in content.odometry.values()]
    source.format, source.topics, source.skipped_unit = bag.kind, notes, "message"
    source.damage, source.part = bag.damage.by_reason(), window.part
    source.skipped_odometry = content.unreadable.merge(tree.skipped, *of_odometry).by_reason()
    return recording


def _static_topics(bag: Bag) -> set[str]:
    return {c.topic for c in bag.channels if c.n_messages and c.topic.endswith(_STATIC)}


def _lend_transforms(tree: TransformTree, others: Sequence[Path], scratch: Path | None) -> None:
    """Add the static transforms of the first of several bags that has any."""
    for path in others:
        try:
            with closing(Bag([path], scratch, trusted=True)) as bag:
                for message in bag.messages(_static_topics(bag)):
                    with suppress(Exception):  # any error of rosbags about damaged bytes
                        tree.add_message(messages.decode(message), static=True)
                if _static_topics(bag):
                    return
        except (messages.DamagedBagError, InputError, OSError):
            continue  # it is reported when it is read itself


def select_topics(bag: Bag, options: ReadOptions) -> tuple[dict[str, str], list[dict[str, Any]]]:
    """Select the topics to read: laser scans, else point clouds, and what belongs to them.

    Returns:
        The use of each topic ("scans", "images", "transforms" or "odometry"), and the type, number
        of messages and use of every topic of the bag.

    Raises:
        InputError: no topic has scans, or a topic that the options name has none.
    """
    faults = {c.id: fault for c in bag.channels if (fault := messages.find_fault(c))}
    faults |= {c.id: "is empty" for c in bag.channels if not c.n_messages}
    of_scans = [c for c in bag.channels if c.type in messages.SCAN_TYPES]
    tilting = {f"{slash}{options.tilting_topic}" for slash in ("", "/")}
    scans = _find_channels(bag, faults, options) or [c for c in of_scans if c.id not in faults]
    scans = [c for c in scans if c.topic not in tilting]
    if not scans:
        named = [f": {c.topic} {faults[c.id]}" for c in of_scans if c.id in faults]
        raise InputError("holds no scans" + "".join(named[:1]), hint=_list_topics(bag.channels))
    lasers = [c for c in scans if c.type != messages.POINT_CLOUD]
    further = {"odometry": (messages.ODOMETRY,), "transforms": (messages.TF, messages.ROS1_TF)}
    if not lasers:
        further["images"] = (messages.IMAGE, messages.COMPRESSED_IMAGE, messages.CAMERA_INFO)
    usable = [c for c in bag.channels if c.id not in faults]
    uses = {c.topic: use for use, types in further.items() for c in usable if c.type in types}
    uses |= dict.fromkeys((c.topic for c in lasers or scans), "scans")
    notes = []
    for c in bag.channels:
        use = uses.get(c.topic)
        why = faults.get(c.id, "not used: others are (read.topic names it)")
        if c.n_messages == 0:
            why = "empty"
        elif use is not None:
            why = f"read for {use}"
        elif c.type not in (*messages.SCAN_TYPES, messages.ODOMETRY, messages.TF, messages.ROS1_TF):
            why = "not used"
        elif c.topic in tilting:
            why = "not for the map: its laser tilts"
        note = {"topic": c.topic, "type": c.type, "messages": c.n_messages}
        notes.append({**note, "used": use is not None, "why": why})
    return uses, notes


def _find_channels(
    bag: Bag, faults: dict[int, str], options: ReadOptions
) -> list[messages.Channel]:
    """The channels of the topics that the options name."""
    named = []
    for name in options.topic.split(",") if options.topic is not None else ():
        own = [c for c in bag.channels if c.topic in (name.strip(), f"/{name.strip()}")]
        scans = [c for c in own if c.type in messages.SCAN_TYPES and c.id not in faults]
        if not scans:
            why = [faults.get(c.id, f"has {c.type}, no scans") for c in own] or ["is not there"]
            raise InputError(f"topic {name.strip()!r} {why[0]}", hint=_list_topics(bag.channels))
        named += scans
    if len({c.type == messages.POINT_CLOUD for c in named}) > 1:
        raise InputError("laser scans and point clouds cannot be used together", hint="name either")
    return named


def _list_topics(channels: list[messages.Channel]) -> str:
    if not channels:
        return "it has no topics"
    of_scans = [c for c in channels if c.type in messages.SCAN_TYPES and c.n_messages]
    shown = [f"{c.topic} ({c.type.rpartition('/')[2]})" for c in (of_scans or channels)[:12]]
    return f"{'topics with scans:' if of_scans else 'it has'} {', '.join(shown)}"


class BagContent:
    """The content of the selected topics, whose `uses` are as in `select_topics`."""

    def __init__(self, uses: dict[str, str], context: ReadContext) -> None:
        self._uses, self._count = uses, Counter[str]()  # scans by topic
        self.window = TimeWindow(context.options)
        self.skipped = messages.SkippedByTopic(SkippedRecords)
        self.lasers = LaserCollector(context.scratch, self.skipped)
        self.clouds = CloudCollector(context.scratch, self.skipped)
        self.images, self.transforms = ImageCollector(), TransformTree()
        self.odometry: dict[str, Odometry] = {}
        self.unreadable = SkippedRecords()

    def add(self, message: messages.Message, number: int) -> None:
        """Add a message; scans and images outside the time window are left out."""
        topic, fault = message.channel.topic, None
        use = self._uses.get(topic)
        self._count[topic] += use == "scans"
        try:
            content = messages.decode(message)
            if self._is_inside_window(message, content, use):
                fault = self._collect(message, content, use)
        except OSError:  # the disk is full
            raise
        except Exception:  # any error of rosbags about damaged bytes
            fault = messages.UNREADABLE
        if fault is not None and use == "scans":
            self.skipped[topic].add(fault, self._count[topic])
        elif fault is not None:
            self.unreadable.add(f"{fault} ({topic})", number)

    def _is_inside_window(self, message: messages.Message, content: Any, use: str | None) -> bool:
        # one CameraInfo holds for all images
        if use not in ("scans", "images") or message.channel.type == messages.CAMERA_INFO:
            return True
        select = self.window.select if use == "scans" else self.window.contains
        return select(messages.stamp_ns(content.header) or message.log_ns)

    def _collect(self, message: messages.Message, content: Any, use: str | None) -> str | None:
        """Add a message to those of its use; returns the reason if it cannot be used."""
        topic = message.channel.topic
        if use == "scans":
            scans = self.clouds if message.channel.type == messages.POINT_CLOUD else self.lasers
            return scans.add(message, content, self._count[topic])
        if use == "images":
            self.images.add_message(message, content)
        elif use == "transforms":
            self.transforms.add_message(content, static=topic.endswith(_STATIC))
        elif use == "odometry":
            self.odometry.setdefault(topic, Odometry(topic)).add_message(content)
        else:  # of a damaged bag whose connections have the number of others
            return messages.UNREADABLE
        return None


def collect_messages(bag: Bag, uses: dict[str, str], context: ReadContext) -> BagContent:
    """Read the topics that have a use.

    Raises:
        DamagedBagError: an indexed bag is damaged.
        InputError: no scan lies in the window.
    """
    content = BagContent(uses, context)
    total = sum(c.n_messages for c in bag.channels if c.topic in uses)
    for number, message in enumerate(bag.messages(set(uses)), start=1):
        count_output(len(message.raw))
        content.add(message, number)
        if context.progress is not None and number % _PROGRESS_INTERVAL == 0:
            context.progress(min(number / max(total, 1), 1.0))
    content.window.require_scans()
    return content
