"""Calibration of a recording before mapping: mounts that are not given, and odometry errors."""

import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from stillmap import em, slam
from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.core.parallel import resolve_threads
from stillmap.core.recording import Recording
from stillmap.core.source import SensorNotes
from stillmap.pipeline.options import Options
from stillmap.prepare import plausibility
from stillmap.prepare.beam_times import add_beam_times
from stillmap.prepare.lasers import mirror_beams
from stillmap.slam.hand_eye import GAIN, SCALE, correct_odometry
from stillmap.slam.mount_calibration import (
    LATENCY,
    POSITION,
    UPSIDE_DOWN,
    YAW,
    Calibration,
    Parameter,
    calibrate_mounts,
    refine_positions,
)
from stillmap.slam.spin_estimation import estimate_spin


def correct_recording(
    recording: Recording, options: Options, poses: Float | None
) -> tuple[Recording, Options, Calibration, list[str]]:
    """Leave out what cannot be, time sweeps, and calibrate; poses (T, D+1, D+1): those to keep.

    Returns:
        the recording without impossible readings, with beam times, mounts and odometry as found;
        options with what was found in place of `auto`; the calibration, empty with given poses; a
        sentence for everything that was changed.
    """
    cell, calibration = options.slam.resolution, Calibration()
    recording, notes = plausibility.remove_leaps(recording)
    if poses is not None:
        recording, more = plausibility.leave_out_far_scans(recording, poses, cell)
        notes += more
    max_range = options.read.max_range or plausibility.stated_max_range(recording)
    recording, more = plausibility.leave_out_far_returns(recording, cell, max_range)
    notes += more
    recording, options, more = time_sweeps(recording, options)
    notes += more
    if poses is None:
        recording, calibration, more = calibrate_recording(recording, options)
        notes += more
    return recording, options, calibration, notes


def calibrate_recording(
    recording: Recording, options: Options
) -> tuple[Recording, Calibration, list[str]]:
    """The recording with the poses of its lasers and its odometry as its own motion shows them.

    Args:
        recording: as read.
        options: what `options.read` gives, and what transforms or PARAMs of the recording state,
            stays.

    Returns:
        The recording, itself where nothing is significantly wrong; the calibration; and a sentence
        for everything that was changed.
    """
    recording, sentences = _interpolate_late_odometry(recording)
    given = [_given_parameters(recording, options, k) for k in range(len(recording.T_base_sensor))]
    found = calibrate_mounts(recording, options.slam.resolution, given)
    applied = apply_calibration(recording, found)
    if any(
        one.significant for laser in found.lasers for name, one in laser.items() if name in POSITION
    ):
        e = em.initial_p_static(applied, options.estimator, options.em)
        threads = resolve_threads(options.threads)
        step = slam.m_step(
            applied, e, options.slam, None, threads, lambda *_: None, with_grid=False
        )
        found = refine_positions(applied, step.poses, found)
        applied = _place_lasers(applied, found)
    for k, laser in enumerate(found.lasers):
        which = "the laser" if len(found.lasers) == 1 else f"laser {k + 1}"
        if found.upside_down[k]:
            sentences.append(f"{which} hangs upside down, as its motion shows: it is mirrored")
        sentences += _describe(which, laser)
    return applied, found, [*sentences, *_describe("odometry", found.odometry)]


def time_sweeps(recording: Recording, options: Options) -> tuple[Recording, Options, list[str]]:
    """The recording with beam times where its sweeps turn out to be distorted by the motion.

    Args:
        recording: as read; unchanged unless it is 3D, without beam times.
        options: with a `read.spin` other than `auto`, nothing is estimated.

    Returns:
        The recording; the options with the direction that was found; and a sentence about it.
    """
    is_open = recording.dimension == 3 and recording.beam_time is None
    is_open &= recording.source.spin is None  # the reader was told that there is none
    if not is_open or options.read.spin != "auto":
        return recording, options, []
    spin = estimate_spin(recording, options.slam, resolve_threads(options.threads))
    if spin is None:
        return recording, options, []
    read = dataclasses.replace(options.read, spin=spin)
    sentence = (
        f"points have no times of their own, but the lidar turns {spin}, as sweeps show: the "
        f"motion during each sweep was removed (read.spin={spin})"
    )
    timed = add_beam_times(recording, spin)
    return timed, dataclasses.replace(options, read=read), [sentence]


def _interpolate_late_odometry(recording: Recording) -> tuple[Recording, list[str]]:
    """The recording with late odometry interpolated, and a sentence about it; 2D only."""
    if recording.T_odom_base is None or recording.dimension != 2:
        return recording, []
    T_odom_base, late = plausibility.interpolate_late_odometry(
        recording.stamp_ns, recording.T_odom_base
    )
    if len(late) == 0:
        return recording, []
    sentence = (
        f"odometry was late at {len(late)} scan{'s' * (len(late) > 1)}, first at scan {late[0]}: "
        "it was interpolated there"
    )
    return dataclasses.replace(recording, T_odom_base=T_odom_base), [sentence]


def apply_calibration(recording: Recording, found: Calibration) -> Recording:
    """The recording with what a calibration found to be significant; 2D."""
    for k, upside_down in enumerate(found.upside_down):
        if upside_down:
            recording = mirror_beams(recording, k)
    if any(one.significant for laser in found.lasers for one in laser.values()):
        recording = _place_lasers(recording, found)
    if any(one.significant for one in found.odometry.values()):
        recording = _correct_odometry(recording, found)
    return recording


def _given_parameters(recording: Recording, options: Options, laser: int) -> set[str]:
    """Mount parameters of a laser that the user, transforms or PARAMs of the log give."""
    chosen = options.read.laser(laser)
    given = {
        name for name, value in zip((*POSITION, YAW), chosen.pose, strict=True) if value is not None
    }
    if chosen.upside_down is not None:
        given.add(UPSIDE_DOWN)
    sensors = recording.source.sensors
    notes = sensors[laser] if laser < len(sensors) else SensorNotes()
    how = "" if notes.extrinsics is None else notes.extrinsics.how
    if how.startswith(("TF", "PARAM", "given")):
        given |= {YAW, *POSITION}
    if how.startswith("TF") or notes.upside_down_how in ("given", "PARAM"):
        given.add(UPSIDE_DOWN)
    return given


def _place_lasers(recording: Recording, found: Calibration) -> Recording:
    T_base_sensor = np.array(recording.T_base_sensor)
    for k, laser in enumerate(found.lasers):
        x, y, theta = se2.parameters(T_base_sensor[k]).tolist()
        known = {"x": x, "y": y, YAW: theta}
        known |= {name: one.value for name, one in laser.items() if one.significant}
        if any(one.significant for one in laser.values()):
            T_base_sensor[k] = se2.matrix(known["x"], known["y"], known[YAW])
    return dataclasses.replace(recording, T_base_sensor=T_base_sensor)


def _correct_odometry(recording: Recording, found: Calibration) -> Recording:
    assert recording.T_odom_base is not None
    seconds = 1e-9 * (recording.stamp_ns - recording.stamp_ns[0])
    applied = {SCALE: 1.0, GAIN: 1.0, LATENCY: 0.0}
    applied |= {name: parameter.applied for name, parameter in found.odometry.items()}
    odometry = correct_odometry(seconds, recording.T_odom_base, **applied)
    return dataclasses.replace(recording, T_odom_base=odometry)


# what a parameter is, its unit, and how many of it are one of ours
_QUANTITIES = {
    YAW: ("yaw on the robot", " degrees", math.degrees(1.0)),
    "x": ("place ahead of the robot's centre", " m", 1.0),
    "y": ("place left of the robot's centre", " m", 1.0),
    SCALE: ("distance, over that of the scans,", "", 1.0),
    GAIN: ("rotation, over that of the scans,", "", 1.0),
    LATENCY: ("delay against the scans", " s", 1.0),
}


def _describe(of: str, parameters: dict[str, Parameter]) -> Iterator[str]:
    """A sentence for each parameter that is not as recorded."""
    for name, parameter in parameters.items():
        if parameter.significant:
            what, unit, factor = _QUANTITIES[name]
            numbers = (parameter.value, parameter.std, parameter.nominal)
            value, std, nominal = (factor * number for number in numbers)
            yield (
                f"{of}: {what} is {value:.4g} +- {std:.2g}{unit}, as the motion shows, not "
                f"{nominal:.4g} as recorded: used"
            )
