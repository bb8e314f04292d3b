"""When the beams of a lidar that spins were taken, where nothing but their directions tells."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillmap.recording.model import Recording
from stillmap.recording.options import ReadOptions

Float = NDArray[np.float64]

NOTED = "spin"  # in the source, of recordings whose times are such
_SENSE = {"clockwise": -1.0, "counter-clockwise": 1.0}
_TURN = 2.0 * math.pi
_RATES = (0.5, 200.0)  # turns per second of lidars; stamps farther apart miss sweeps


def timed(recording: Recording, options: ReadOptions) -> Recording:
    """The recording with beam times as the direction of the spin says.

    A turn takes from one stamp to the next, or as long as `spin_rate` says. Where it begins,
    directions jump from the last beam to the first.

    Args:
        recording: 3D. It comes back as it is where `spin` names no direction; where its beams have
            times, or there is no rate, with a warning.
        options: `spin`, `spin_rate`, `spin_start` and `spin_stamp`.
    """
    if options.spin not in _SENSE or NOTED in recording.source:
        return recording
    if recording.beam_time is not None:
        return _warned(recording, "the spin is not used: beams have times of their own")
    rates = [_rate(recording, k, options) for k in range(len(recording.T_base_sensor))]
    if not all(rates):
        return _warned(recording, "the spin is not used: stamps tell no rate, set read.spin_rate")
    per_second = np.array(rates, np.float64)
    beam_time = recording.per_beam(np.float32)
    for t in recording.in_turn(range(recording.n_scans), beam_time):
        beams = recording.beams_of(t)
        turned = turns(recording.points[beams], options)
        beam_time[beams] = turned / per_second[recording.sensor[t]]
    noted = {
        "direction": options.spin,
        "turns_per_second": [round(float(rate), 4) for rate in per_second],
        "start": options.spin_start,
        "stamp": options.spin_start if options.spin_stamp is None else options.spin_stamp,
    }
    return replace(recording, beam_time=beam_time, source={**recording.source, NOTED: noted})


def turns(points: NDArray[np.float32], options: ReadOptions) -> Float:
    """(n,) turns from the stamp to each of points (n, 3) in the sensor's frame; 0 for unusable."""
    sense = _SENSE[options.spin]
    azimuth = np.arctan2(points[:, 1].astype(np.float64), points[:, 0].astype(np.float64))
    stamp = options.spin_start if options.spin_stamp is None else options.spin_stamp
    after = np.mod(sense * (azimuth - options.spin_start), _TURN)
    until_stamp = math.fmod(sense * (stamp - options.spin_start), _TURN) % _TURN
    return np.nan_to_num((after - until_stamp) / _TURN)


def _rate(recording: Recording, sensor: int, options: ReadOptions) -> float | None:
    """Turns per second of a sensor; None where nothing tells."""
    if options.spin_rate is not None:
        return options.spin_rate
    stamps = recording.stamp_ns[recording.sensor == sensor]
    if len(stamps) < 2:
        return None
    seconds = float(np.median(np.diff(stamps))) / 1e9
    return 1.0 / seconds if 1.0 / _RATES[1] <= seconds <= 1.0 / _RATES[0] else None


def _warned(recording: Recording, what: str) -> Recording:
    warnings = [*recording.source.get("warnings", []), what]
    return replace(recording, source={**recording.source, "warnings": warnings})
