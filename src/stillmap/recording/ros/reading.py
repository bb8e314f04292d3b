"""ROS bags as recordings, without ROS."""

from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap import se2
from stillmap.errors import InputError
from stillmap.recording import extrinsics
from stillmap.recording.extrinsics import Extrinsics
from stillmap.recording.lines import Progress
from stillmap.recording.model import Recording
from stillmap.recording.options import ReadOptions
from stillmap.recording.ros import base, beams, reading_clouds, tilting
from stillmap.recording.ros.bags import open_bag, size_of
from stillmap.recording.ros.channels import Bag, DamagedError
from stillmap.recording.ros.choosing import chosen_topics
from stillmap.recording.ros.gathered import Content, content
from stillmap.recording.ros.lasers import Scans
from stillmap.recording.ros.unpacking import bounded
from stillmap.recording.ros.used import loss_warning, used_lasers
from stillmap.recording.skipped import Skipped

OfLasers = Callable[[Content, ReadOptions, Path | None], Recording]

_STILL = (1e-3, 1e-3)  # m, rad: a sensor that moves less on its robot does not


def read(
    path: Path, options: ReadOptions, progress: Progress | None, scratch: Path | None
) -> Recording:
    """Read a bag: ROS 1, or a file or folder of ROS 2.

    Bad messages are skipped and counted. A bag that is cut, damaged or without index is read from
    the front as far as it goes.

    Raises:
        InputError: it cannot be read, or holds no usable scan.
    """
    return _read(path, options, progress, scratch, _of_lasers)


def read_tilting(
    path: Path, options: ReadOptions, progress: Progress | None, scratch: Path | None
) -> Recording:
    """Read the scans of a laser that tilts or pans as points in 3D, by the transforms of a bag.

    Args:
        path: of the bag.
        options: `topic` names its scans, or clouds made from them; `base_frame` the robot.
        progress, scratch: as for any recording.

    Raises:
        InputError: it cannot be read, or nothing says how the laser moves.
    """
    return _read(path, options, progress, scratch, tilting.of_laser)


def _read(
    path: Path,
    options: ReadOptions,
    progress: Progress | None,
    scratch: Path | None,
    of_lasers: OfLasers,
) -> Recording:
    damaged, size = "", size_of(path)
    for trusted in (True, False):
        try:
            with bounded(size), closing(open_bag(path, scratch, trusted=trusted)) as bag:
                recording = _recording(
                    bag,
                    options,
                    progress,
                    scratch,
                    partial(open_bag, path, scratch, trusted=trusted),
                    of_lasers,
                )
        except DamagedError as error:
            damaged = str(error)
        except InputError as error:
            if damaged and not error.where:
                what = f"{error.what}; it is damaged: {damaged}"
                raise InputError(what, where=str(path), hint=error.hint) from error
            raise InputError(error.what, where=error.where or str(path), hint=error.hint) from error
        else:
            recording.source.update(path=str(path), format=bag.kind)
            if damaged:
                said = (
                    f"the bag is cut or damaged ({damaged.rstrip('.')}): what could be read is used"
                )
                recording.source["warnings"].insert(0, said)
            return recording
    raise InputError(f"is damaged: {damaged}", where=str(path))


def origins(bag: Bag, options: ReadOptions, scratch: Path | None) -> list[tuple[str, int]]:
    """(T,) the topic and the number of the message, from 1, that each scan of a bag is.

    Raises:
        DamagedError: the bag is not whole.
        InputError: it holds no usable scan.
    """
    chosen = chosen_topics(bag, options)
    if chosen.clouds:
        raise InputError("holds point clouds: beams of laser scans alone can be blanked")
    found = content(bag, chosen, options, None, scratch)
    used = used_lasers(found, options)[0]
    stamps = np.concatenate([scans.stamp_ns for scans in used])
    all_of_them = [(scans.topic, int(number)) for scans in used for number in scans.number]
    return [all_of_them[scan] for scan in np.argsort(stamps, kind="stable")]


def _recording(
    bag: Bag,
    options: ReadOptions,
    progress: Progress | None,
    scratch: Path | None,
    reopened: Callable[[], Bag],
    of_lasers: OfLasers,
) -> Recording:
    chosen = chosen_topics(bag, options)
    found = content(bag, chosen, options, progress, scratch)
    if chosen.clouds:
        recording = reading_clouds.recording(
            found,
            options,
            lambda base: found.pictures.images(found.transforms, base, reopened),
        )
    else:
        recording = of_lasers(found, options, scratch)
    recording.source.update(
        topics=chosen.notes,
        skipped_unit="message",
        damage=bag.damage.to_dict(),
        skipped_odometry=found.skipped_odometry.to_dict(),
    )
    return recording


def _of_lasers(found: Content, options: ReadOptions, scratch: Path | None) -> Recording:
    used, T, placed, skipped, left_out = used_lasers(found, options)
    options.require_lasers(len(used))
    warnings = [w for s in used for w in s.warnings] + base.words(placed)
    T_base_sensor, sensor, mirrored, infos, more = _sensors(used, T, placed, options)
    warnings += more
    rules = []
    for scans, info in zip(used, infos, strict=True):
        rule, more = beams.understood(scans, options)
        info["ranges"] = rule.to_dict()
        rules.append(rule)
        warnings += [f"{scans.topic}: {text}" for text in more]
    all_beams = beams.all_beams(used, rules, mirrored, scratch)
    stamp_ns = np.concatenate([s.stamp_ns for s in used])[all_beams.scan]
    odom, told, more = base.odometry_at(
        found.transforms, placed.base, found.odometry, stamp_ns, options
    )
    lost = Skipped().merged(*(skipped[topic] for topic in {s.topic for s in used}))
    warnings += more + loss_warning(sum(s.n_scans for s in used), lost)
    return Recording(
        stamp_ns=stamp_ns,
        offset=all_beams.offset,
        points=all_beams.points,
        hit=all_beams.hit,
        T_base_sensor=T_base_sensor,
        sensor=sensor[all_beams.scan],
        T_odom_base=None if odom is None else base.planar(odom)[0],
        beam_time=all_beams.beam_time,
        source={
            "sensors": infos,
            "base_frame": placed.base,
            "base_frame_how": placed.how,
            "odometry": told,
            "skipped": lost.to_dict(),
            "duplicates": left_out,
            "warnings": warnings,
        },
    )


def _sensors(
    lasers: list[Scans],
    T: list[NDArray[np.float64]],
    placed: base.Places,
    options: ReadOptions,
) -> tuple[NDArray[np.float64], NDArray[np.int32], list[bool], list[dict[str, Any]], list[str]]:
    """Where the lasers sit, seen from above.

    Returns:
        (S, 3, 3) T_base_sensor; (T,) int32 which of them each scan has, the scans of one laser
        after those of another; whether each laser's beams are turned round; notes on each laser;
        warnings. A laser that moves on its robot has a place for every scan.
    """
    places, sensor, mirrored, infos, warnings = [], [], [], [], []
    count = 0
    for number, (scans, on_robot) in enumerate(zip(lasers, T, strict=True)):
        flat, upside_down, tilts = base.planar(on_robot)
        given = options.laser(number)
        if tilts:
            warnings.append(f"{scans.topic}: the laser is tilted; its scans are taken for level")
        if not _moves(flat) or given.place != (None, None, None):
            flat = flat[:1]
            x, y, theta = se2.parameters(flat)[0].tolist()
            place = extrinsics.overridden(Extrinsics(x, y, theta, _how(scans, placed)), given)
            flat = place.matrix()[None]
        else:
            x, y, theta = se2.parameters(flat)[0].tolist()
            place = Extrinsics(x, y, theta, "TF, it moves: at its first scan")
        how = "given" if given.upside_down is not None else "TF"
        upside_down = upside_down if given.upside_down is None else given.upside_down
        its = np.arange(scans.n_scans) if len(flat) > 1 else np.zeros(scans.n_scans)
        places.append(flat)
        sensor.append((its + count).astype(np.int32))
        mirrored.append(upside_down)
        infos.append({**_info(scans, place, upside_down, how), "places": len(flat)})
        count += len(flat)
    return np.concatenate(places), np.concatenate(sensor), mirrored, infos, warnings


def _moves(flat: NDArray[np.float64]) -> bool:
    metres, radians = _STILL
    away = se2.parameters(se2.inverse(flat[:1]) @ flat)
    return bool(np.abs(away[:, :2]).max() > metres or np.abs(away[:, 2]).max() > radians)


def _how(scans: Scans, placed: base.Places) -> str:
    if scans.frame == placed.base:
        return "the laser is the robot's frame"
    return f"TF from {placed.base} to {scans.frame}"


def _info(scans: Scans, place: Extrinsics, upside_down: bool, how: str) -> dict[str, Any]:
    usual = scans.usual
    sign = -1.0 if upside_down else 1.0
    return {
        "name": scans.topic,
        "frame": scans.frame,
        "scans": scans.n_scans,
        "beams_per_scan": usual.n,
        "start_angle": sign * usual.angle_min,
        "angle_step": sign * usual.angle_increment,
        "upside_down": upside_down,
        "upside_down_how": how,
        "extrinsics": place.to_dict(),
    }
