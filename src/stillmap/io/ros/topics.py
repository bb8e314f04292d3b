"""Which topics of a bag make the recording, and why."""

from typing import Any, NamedTuple

from stillmap.core.errors import InputError
from stillmap.io.ros.bag_types import Bag, Channel
from stillmap.io.ros.laser_scan import LaserScans
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
    find_fault,
)
from stillmap.preprocessing.options import ReadOptions

_SCANS = (LASER_SCAN, MULTI_ECHO, POINT_CLOUD)
_RARE = 0.25  # of the most frequent scans: rarer topics are no sensors of their own


class TopicSelection(NamedTuple):
    """Topics by what they are read for.

    Attributes:
        lasers, clouds: topics of scans; one of the two is empty.
        tf, odometry, images: topics beside them.
        notes: for each topic of the bag its type, messages, and what became of it.
    """

    lasers: set[str]
    clouds: set[str]
    tf: set[str]
    odometry: set[str]
    images: set[str]
    notes: list[dict[str, Any]]

    @property
    def all(self) -> set[str]:
        return self.lasers | self.clouds | self.tf | self.odometry | self.images


def select_topics(bag: Bag, options: ReadOptions) -> TopicSelection:
    """What to read.

    Raises:
        InputError: no topic has scans, or a topic that the options name has none.
    """
    channels = [c for c in bag.channels if c.n_messages]
    usable = [c for c in channels if find_fault(c) is None]
    scans = _find_named(usable, bag, options) or [c for c in usable if c.type in _SCANS]
    tilting = _tilting(options)
    scans = [c for c in scans if c.topic not in tilting]
    if not scans:
        raise InputError(_no_scans(bag.channels), hint=_topics(bag.channels))
    flat = {c.topic for c in scans if c.type != POINT_CLOUD}
    clouds = {c.topic for c in scans if c.type == POINT_CLOUD} if not flat else set()
    of_3d = bool(clouds)
    by_type = {
        kind: {c.topic for c in usable if c.type == kind} for kind in {c.type for c in usable}
    }
    pictures = by_type.get(IMAGE, set()) | by_type.get(COMPRESSED_IMAGE, set())
    chosen = TopicSelection(
        lasers=flat,
        clouds=clouds,
        tf=by_type.get(TF, set()) | by_type.get(ROS1_TF, set()),
        odometry=by_type.get(ODOMETRY, set()),
        images=pictures | by_type.get(CAMERA_INFO, set()) if of_3d else set(),
        notes=[],
    )
    chosen.notes.extend(_describe_topic(c, chosen, tilting) for c in bag.channels)
    return chosen


def _find_named(usable: list[Channel], bag: Bag, options: ReadOptions) -> list[Channel]:
    if options.topic is None:
        return []
    found = []
    for name in (part.strip() for part in options.topic.split(",")):
        wanted = {name, f"/{name}"}
        of_name = [c for c in bag.channels if c.topic in wanted]
        usable_ones = [c for c in of_name if c in usable and c.type in _SCANS]
        if not usable_ones:
            faults = [find_fault(c) or f"has {c.type}, no scans" for c in of_name if c.n_messages]
            fault = faults[0] if faults else ("is empty" if of_name else "is not there")
            raise InputError(f"topic {name!r} {fault}", hint=_topics(bag.channels))
        found += usable_ones
    if len({c.type == POINT_CLOUD for c in found}) > 1:
        raise InputError("laser scans and point clouds cannot be used together", hint="name either")
    return found


def _tilting(options: ReadOptions) -> set[str]:
    """The topic that is not for the map, as it may be written."""
    name = options.tilting_topic
    return set() if name is None else {name, f"/{name}"}


def _no_scans(channels: list[Channel]) -> str:
    empty = [c.topic for c in channels if c.type in _SCANS and not c.n_messages]
    odd = [f"{c.topic} {find_fault(c)}" for c in channels if c.type in _SCANS and find_fault(c)]
    if odd:
        return f"holds no scans that can be read: {odd[0]}"
    return f"holds no scans: {empty[0]} is empty" if empty else "holds no scans"


def _topics(channels: list[Channel]) -> str:
    if not channels:
        return "it has no topics"
    of_scans = [c for c in channels if c.type in _SCANS and c.n_messages]
    named = ", ".join(
        f"{c.topic} ({c.type.rpartition('/')[2]})" for c in (of_scans or channels)[:12]
    )
    return f"topics with scans: {named}" if of_scans else f"it has {named}"


def _describe_topic(channel: Channel, chosen: TopicSelection, tilting: set[str]) -> dict[str, Any]:
    """What became of a topic."""
    reasons = {
        "scans": chosen.lasers | chosen.clouds,
        "transforms": chosen.tf,
        "odometry": chosen.odometry,
        "pictures": chosen.images,
    }
    used = [what for what, topics in reasons.items() if channel.topic in topics]
    relevant = channel.type in (*_SCANS, ODOMETRY, TF, ROS1_TF)
    fault = find_fault(channel) if relevant else None
    if channel.n_messages == 0:
        why = "empty"
    elif used:
        why = f"read for {used[0]}"
    elif fault:
        why = fault
    elif channel.topic in tilting:
        why = "not for the map: its laser tilts"
    elif channel.type == POINT_CLOUD:
        why = "not used: the laser scans are (name it to use it instead)"
    elif channel.type in _SCANS:
        why = "not used: others are named"
    else:
        why = "not used"
    return {
        "topic": channel.topic,
        "type": channel.type,
        "messages": channel.n_messages,
        "used": bool(used),
        "why": why,
    }


def chosen_lasers(found: list[LaserScans], named: bool) -> tuple[list[LaserScans], list[str]]:
    """The lasers to use, the busiest first, and words on those that are left out.

    Of topics that show the same laser (the same frame) the one with most scans is used, of equal
    ones the one with more beams, then the first by name. Topics with few scans are left out.

    Args:
        found: all that have been read.
        named: whether the user named their topics: then only the same laser is used once.
    """
    order = sorted(found, key=lambda s: (-s.n_scans, -int(s.lengths[0]), s.topic))
    used: list[LaserScans] = []
    left_out = []
    for scans in order:
        same = next((u for u in used if u.frame == scans.frame), None)
        if same is not None:
            left_out.append(
                f"{scans.topic}: {scans.n_scans} scans, {same.topic} shows the same laser"
            )
        elif not named and used and scans.n_scans < _RARE * used[0].n_scans:
            left_out.append(
                f"{scans.topic}: {scans.n_scans} scans are too few beside {used[0].topic}"
            )
        else:
            used.append(scans)
    return used, left_out
