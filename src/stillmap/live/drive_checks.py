"""Checks of the files of a kept drive: types, shapes and ranges of values."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import iter_blocks
from stillmap.core.timestamps import MAX_BEAM_TIME, are_dated
from stillmap.io.rigid_transforms import MAX_TRANSLATION, are_rigid
from stillmap.live.cloud_extension import KeptCloud
from stillmap.live.history import KeptScans, answer_type
from stillmap.live.placement import Placement
from stillmap.results.reader import is_hit_sum, is_probability

Float = NDArray[np.float64]

_CLOUD_TYPES = [np.float64, np.float32, np.float64, np.bool_]


def check_arrays(D: int, rows: Sequence[int], given: Sequence[NDArray[Any]]) -> None:
    """Refuse arrays of scans of other types or lengths than were written.

    Args:
        D: dimension.
        rows: of beams in each part.
        given: number, counts, answers, poses and submap.

    Raises:
        ValueError: they are others.
    """
    number, counts, answers, poses, submap = given
    int64, T = np.dtype(np.int64), number.size
    types = [int64, int64, answer_type(D), np.dtype(np.float64), submap.dtype]
    if (
        [one.dtype for one in given] != types
        or not np.issubdtype(submap.dtype, np.integer)
        or {one.shape for one in (number, counts, answers, submap)} != {(T,)}
        or poses.shape != (T, D + 1, D + 1)
        or not T
        or (counts < 0).any()
        or (counts > sum(rows)).any()
        or counts.sum() != sum(rows)
    ):
        raise ValueError("its arrays do not fit together")


def check_scans(kept: KeptScans, placement: Placement) -> None:
    """Refuse scans and answers with values that no drive has.

    Raises:
        ValueError: names what cannot be.
    """
    number, answers, submap = kept.number, kept.answers, placement.submap
    if number[0] < 0 or (number[1:] <= number[:-1]).any():
        raise ValueError("the numbers of its scans do not rise")
    stamp_ns = answers["stamp_ns"]
    if not are_dated(stamp_ns) or (stamp_ns[1:] < stamp_ns[:-1]).any():
        raise ValueError("its stamps fall, or are no times from 1824 to 2116")
    if submap.min() < -1 or submap.max() > len(number):
        raise ValueError("a scan is in a submap that cannot be")
    poses = [answers["pose"], answers["local"], placement.poses[submap >= 0]]
    poses += [answers["T_odom_base"]] if kept.has_odometry else []
    if not all(map(are_rigid, poses)) or not np.isfinite(answers["twist"]).all():
        raise ValueError("a pose or a twist cannot be")
    _check_beams(*kept.parts)


def check_sensors(D: int, mounts: Sequence[Float], sensor: NDArray[np.int32]) -> None:
    """Refuse sensors that are not there.

    Raises:
        ValueError: a scan is of none, or a mount is no pose.
    """
    is_shaped = {mount.shape for mount in mounts} == {(D + 1, D + 1)}
    if not is_shaped or not are_rigid(np.array(mounts)):
        raise ValueError("a mount is no pose")
    if sensor.min() < 0 or sensor.max() >= len(mounts):
        raise ValueError("a scan is of no sensor")


def check_map(layers: Sequence[NDArray[Any]]) -> None:
    """Refuse a planar map (H, W) and its hits that cannot be.

    Raises:
        ValueError: they are none.
    """
    p_occupied, hits = layers
    is_plane = p_occupied.ndim == 2 and p_occupied.shape == hits.shape
    if not is_plane or {one.dtype.kind for one in layers} != {"f"}:
        raise ValueError("its known map does not fit")
    if not (is_probability(p_occupied) and is_hit_sum(hits)):
        raise ValueError("its known map holds what no map does")


def check_cloud(cloud: KeptCloud, shape: tuple[int, ...]) -> None:
    """Refuse a cloud that cannot be that of a planar map of a shape (H, W).

    Raises:
        ValueError: it is none.
    """
    given: list[NDArray[Any]] = [cloud.points, cloud.p_static, cloud.route, cloud.stands]
    n, route = cloud.p_static.size, len(cloud.route) if cloud.route.ndim else 0
    shapes = [(n, 3), (n,), (route, 4, 4), shape]
    if [one.shape for one in given] != shapes or [one.dtype for one in given] != _CLOUD_TYPES:
        raise ValueError("its known cloud does not fit")
    is_near = all(_is_within(cloud.points[b], MAX_TRANSLATION) for b in iter_blocks(cloud.points))
    if not (is_near and is_probability(cloud.p_static) and are_rigid(cloud.route)):
        raise ValueError("its known cloud holds what no cloud does")


def _check_beams(
    points: list[NDArray[Any]],
    hit: list[NDArray[Any]],
    p_static: list[NDArray[Any]],
    time: list[NDArray[Any]],
) -> None:
    for ends, hits, labels, times in zip(points, hit, p_static, time, strict=True):
        for block in iter_blocks(hits):
            known = ~np.isnan(ends[block]).any(axis=1)
            if (hits[block] & ~known).any() or not _is_within(ends[block][known], MAX_TRANSLATION):
                raise ValueError("a beam ends where none does")
            if not _is_within(times[block], MAX_BEAM_TIME):
                raise ValueError("a beam has no possible time")
        if not is_probability(labels):
            raise ValueError("a beam has no probability")


def _is_within(values: NDArray[Any], limit: float) -> bool:
    """True if all values are numbers up to a limit in magnitude."""
    return bool((np.abs(values) <= limit).all())
