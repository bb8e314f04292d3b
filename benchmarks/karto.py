"""Karto's scan matcher and pose graph, as the package index has them, on what stillmap reads.

python benchmarks/karto.py RECORDING -o DIR --karto-python PYTHON

PYTHON is an interpreter of its own, so that nothing else is touched:
    python3 -m venv karto && karto/bin/pip install yag-slam opencv-python-headless
yag-slam (GPL-3.0, like its matcher) imports OpenCV but does not ask for it. It is compared with,
never needed. DIR gets trajectory.tum; CPU time and closed loops are printed.

Parameters are yag-slam's own, see karto_worker.py. The recording says the angles of the beams,
where the laser sits and which readings are no returns: those are NaN, which its matcher leaves
out. A scan is taken when the odometry moved 0.5 m or 0.5 rad since the last one that was, as its
README and its ROS node have it; the others are carried by odometry from there.
"""

import os
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import make_parser, timed
from numpy.typing import NDArray

import stillmap
from stillmap.core import se2
from stillmap.core.files import atomic_folder
from stillmap.io.trajectory import write_tum

Float = NDArray[np.float64]

MIN_DISTANCE = 0.5  # m
MIN_ROTATION = 0.5  # rad
_UNEVEN = 1e-3  # rad that beams may lie off an even spacing
_WORKER = Path(__file__).with_name("karto_worker.py")
# what is idle and spins would be counted, too
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


class KartoError(Exception):
    """Why there is no result, in a few words."""


@dataclass(frozen=True, eq=False)
class Mapped:
    """What Karto found.

    Attributes:
        poses: (T, 3, 3) T_map_base of all scans, as known at the end.
        answers: (T, 3, 3) likewise, as known when the last scan that was taken had been processed.
        taken: how many scans it was given, see `moved`.
        closed: after how many of them a loop was closed.
        cpu: seconds that it worked on the scans.
        process_cpu: seconds of its whole process, from the interpreter's start to its end.
    """

    poses: Float
    answers: Float
    taken: int
    closed: int
    cpu: float
    process_cpu: float


def main() -> None:
    p = make_parser(__doc__)
    p.add_argument("recording", type=Path)
    p.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    p.add_argument("--overwrite", action="store_true", help="replace what is in DIR")
    p.add_argument("--karto-python", required=True, metavar="PYTHON")
    args = p.parse_args()
    recording = stillmap.read(args.recording)
    try:
        found = mapped(recording, args.karto_python)
    except KartoError as error:
        raise SystemExit(f"Karto: {error}") from error
    with atomic_folder(args.output, "trajectory.tum", args.overwrite) as folder:
        write_tum(folder / "trajectory.tum", recording.stamp_ns, found.poses)
    print(
        f"{recording.n_scans} scans, {found.taken} taken, loops closed after {found.closed}; "
        f"CPU {1e3 * found.cpu / recording.n_scans:.2f} ms per scan, "
        f"{1e3 * found.process_cpu / recording.n_scans:.2f} with all of its process"
    )


def mapped(recording: stillmap.Recording, python: str | None) -> Mapped:
    """What Karto makes of a recording with one laser and odometry.

    Raises:
        KartoError: it is not there, cannot take the recording, or fails.
    """
    require(python)
    if recording.T_odom_base is None:
        raise KartoError("needs odometry")
    first, step, ranges = evenly(recording)
    T_odom_sensor = recording.T_map_sensor(recording.T_odom_base)
    taken = moved(T_odom_sensor)
    with tempfile.TemporaryDirectory() as work:
        given, found = Path(work, "scans.npz"), Path(work, "found.npz")
        scans = {"ranges": ranges[taken], "odometry": se2.parameters(T_odom_sensor[taken])}
        np.savez(given, **scans, first_angle=first, angle_step=step)
        _, process_cpu = _run(str(python), str(_WORKER), str(given), str(found))
        answer = np.load(found)
        poses, answers = (
            carried(
                se2.matrix(*answer[name].T) @ se2.inverse(recording.T_base_sensor),
                taken,
                recording.T_odom_base,
            )
            for name in ("poses", "answers")
        )
        closed, cpu = int(answer["closed"]), float(answer["cpu"])
    return Mapped(poses, answers, len(taken), closed, cpu, process_cpu)


def require(python: str | None) -> None:
    """Raises KartoError when there is no interpreter, or none that has yag-slam."""
    if python is None:
        raise KartoError("no --karto-python")
    _run(python, "-c", "import yag_slam.graph_slam")


def _run(*command: str) -> tuple[str, float]:
    try:
        return timed(command, env={**os.environ, **_ONE_THREAD}, stderr=subprocess.PIPE)
    except OSError as error:
        raise KartoError(f"{command[0]}: {error.strerror}") from error
    except subprocess.CalledProcessError as error:
        said = error.stderr.strip().splitlines() or [f"exit status {error.returncode}"]
        raise KartoError(said[-1]) from error


def evenly(recording: stillmap.Recording) -> tuple[float, float, Float]:
    """Angle of the first beam, from one to the next, and ranges (T, n) in m; NaN: no return.

    Angles are in rad and rise; beams are turned around where the recording has them fall.
    """
    beams = np.unique(np.diff(recording.offset))
    if len(recording.T_base_sensor) != 1 or len(beams) != 1:
        raise KartoError("needs one laser with as many beams in every scan")
    points = recording.points.astype(np.float64).reshape(recording.n_scans, -1, 2)
    ranges = np.hypot(points[..., 0], points[..., 1])
    ahead = np.where(ranges > 0, ranges, np.nan)[..., None]
    seen = np.flatnonzero(np.isfinite(ahead[..., 0]).any(axis=0))
    if len(seen) < 2:
        raise KartoError("needs beams that can be used")
    x, y = np.nanmean(points[:, seen] / ahead[:, seen], axis=0).T
    angles = np.unwrap(np.arctan2(y, x))
    step, first = np.polyfit(seen, angles, 1)
    if np.abs(first + step * seen - angles).max() > _UNEVEN:
        raise KartoError("needs beams that are evenly spread")
    ranges[~recording.hit.reshape(ranges.shape)] = np.nan
    if step > 0:
        return float(first), float(step), ranges
    return float(first + step * (ranges.shape[1] - 1)), float(-step), ranges[:, ::-1]


def moved(T_odom_sensor: Float) -> NDArray[np.intp]:
    """The scans that are taken: the first one, and each that is far from the last one taken."""
    odometry, taken = se2.parameters(T_odom_sensor), [0]
    for t, (x, y, heading) in enumerate(odometry):
        x0, y0, heading0 = odometry[taken[-1]]
        turned = abs(se2.wrap(heading - heading0))
        if np.hypot(x - x0, y - y0) >= MIN_DISTANCE or turned >= MIN_ROTATION:
            taken.append(t)
    return np.array(taken, np.intp)


def carried(poses: Float, taken: NDArray[np.intp], T_odom_base: Float) -> Float:
    """Poses (T, 3, 3) of all scans: by odometry from the last one taken, which are (K, 3, 3)."""
    last = np.searchsorted(taken, np.arange(len(T_odom_base)), side="right") - 1
    out: Float = poses[last] @ se2.inverse(T_odom_base[taken[last]]) @ T_odom_base
    return out


if __name__ == "__main__":
    main()
