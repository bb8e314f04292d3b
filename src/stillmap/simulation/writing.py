"""A simulation as a folder: the recording and, beside it, the truth."""

import math
from pathlib import Path
from typing import Literal

import numpy as np

from stillmap import se2
from stillmap.errors import InputError
from stillmap.output.atomic import new_folder
from stillmap.recording import folder
from stillmap.recording.model import Recording
from stillmap.simulation.options import LaserOptions
from stillmap.simulation.simulator import Simulation
from stillmap.simulation.truth import write_truth

Format = Literal["stillmap", "carmen"]

CARMEN_LOG = "recording.log"
_NO_RETURN = 81.83  # m, what a SICK LMS reports when nothing comes back


def write_simulation(
    simulation: Simulation,
    path: str | Path,
    *,
    format: Format = "stillmap",
    overwrite: bool = False,
) -> None:
    """Write recording and truth into one folder that appears complete or not at all.

    Args:
        simulation: what `simulate` returned.
        path: the folder.
        format: "stillmap" writes the files of a recording folder, "carmen" a `recording.log`
            with FLASER, RLASER and ODOM lines, ranges in whole centimetres.
        overwrite: replace what is in the folder.

    Raises:
        InputError: the folder holds something already or cannot be written to, or the format
            cannot say what the laser measures.
    """
    if format == "carmen":
        require_carmen(simulation.scene.laser)
    with new_folder(Path(path), overwrite) as work:
        if format == "carmen":
            _write_carmen(simulation, work / CARMEN_LOG)
        else:
            folder.write_into(simulation.recording, work)
        write_truth(simulation.truth, simulation.recording.stamp_ns, work)


def require_carmen(laser: LaserOptions) -> None:
    """Whether FLASER lines can hold such scans: half a circle, ranges below the SICK's code.

    Raises:
        InputError: they cannot.
    """
    if abs(laser.fov - math.pi) > 1e-9:
        raise InputError("FLASER lines hold half a circle", hint="a field of view of 180 degrees")
    if laser.upside_down == "known":
        raise InputError(
            "FLASER lines cannot say that the laser hangs upside down",
            hint="laser.upside_down=unknown",
        )
    if laser.max_range > _NO_RETURN:
        raise InputError(f"CARMEN logs hold ranges up to {_NO_RETURN} m", hint="a lower max_range")


def _write_carmen(simulation: Simulation, path: Path) -> None:
    recording = simulation.recording
    assert recording.T_odom_base is not None
    base = se2.parameters(recording.T_odom_base)
    laser = se2.parameters(recording.T_map_sensor(recording.T_odom_base))
    first = int(recording.stamp_ns[0])
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(f"# stillmap simulate {simulation.scene.name}\n")
        for t, stamp in enumerate(recording.stamp_ns.tolist()):
            times = f"{_seconds(stamp)} simulated {_seconds(stamp - first)}\n"
            file.write(f"ODOM {_pose(base[t])} 0 0 0 {times}")
            readings = _readings(recording, t)
            name = "RLASER" if recording.sensor[t] else "FLASER"
            file.write(f"{name} {readings} {_pose(laser[t])} {_pose(base[t])} {times}")


def _readings(recording: Recording, scan: int) -> str:
    beams = recording.beams_of(scan)
    ranges = np.hypot(*recording.points[beams].astype(np.float64).T)
    ranges = np.where(recording.hit[beams], ranges, _NO_RETURN)
    return f"{len(ranges)} " + " ".join(f"{r:.2f}" for r in ranges.tolist())


def _pose(pose: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in pose.tolist())


def _seconds(stamp_ns: int) -> str:
    # CARMEN writes microseconds; beyond them the stamp would not be the same as in the truth
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"
