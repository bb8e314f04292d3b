"""Is the direction found in which a lidar without point times spins?

python benchmarks/spin.py [--scans 72] [--seeds 28] [--processes 2] [--folders DIR ...]

Each simulated drive is given as recorded (counter-clockwise), mirrored (clockwise) where its seed
is odd, and without the motion during its sweeps (none), in each case without beam times. DIR is a
KITTI folder: as it is, and without the motion as it is found.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import outcomes
from tables import markdown

import stillmap
from stillmap.prepare.beam_times import SPIN_KEY, add_beam_times
from stillmap.sim import scene_by_name, simulate
from stillmap.slam import deskew_recording, spin_estimation
from stillmap.slam.options import SlamOptions

WORLDS = ("street", "street-jam", "street-turn", "crossing", "hall", "corridor", "office")
OUTDOORS = ("street", "street-jam", "street-turn", "crossing")
SPEEDS = {True: (3.0, 6.0, 10.0, 14.0), False: (0.8, 1.5, 2.5)}  # m/s outdoors, indoors
LIDARS = ((16, 900), (32, 600), (64, 450))  # channels and columns
_BOUNDS = (0.0, 4.0, 8.0, 20.0)  # m/s, of the rows of the table


class Drive(NamedTuple):
    """A simulated drive."""

    world: str
    speed: float
    channels: int
    columns: int
    seed: int
    scans: int


class Answer(NamedTuple):
    """The true direction of a drive and the one that was found; None: no distortion."""

    speed: float
    true: str | None
    found: str | None


def main() -> None:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--scans", type=int, default=72)
    p.add_argument("--seeds", type=int, default=28, help="number of drives")
    p.add_argument("--processes", type=int, default=2)
    p.add_argument("--folders", nargs="+", type=Path, default=[], metavar="DIR")
    args = p.parse_args()
    for folder in args.folders:
        print("\n".join(_of_folder(folder)))
    if args.folders:
        return
    drives = list(_draw(args.seeds, args.scans))
    print(_table([one for _, found in outcomes(_answers, drives, args.processes) for one in found]))


def _draw(n: int, scans: int) -> Iterator[Drive]:
    rng = np.random.default_rng(1)
    for k in range(n):
        world = WORLDS[k % len(WORLDS)]
        speed = float(rng.choice(SPEEDS[world in OUTDOORS]))
        channels, columns = LIDARS[int(rng.integers(len(LIDARS)))]
        yield Drive(world, speed, channels, columns, int(rng.integers(1000)), scans)


def _answers(drive: Drive) -> list[Answer]:
    lidar = {"channels": drive.channels, "columns": drive.columns}
    changes = {"robot": {"speed": drive.speed, "scans": drive.scans}, "lidar": lidar}
    run = simulate(scene_by_name(drive.world, changes), drive.seed)
    timed = replace(run.recording, T_odom_base=None)
    at_once = deskew_recording(timed, run.truth.T_world_base, SlamOptions())
    cases: list[tuple[str | None, stillmap.Recording]] = [
        ("counter-clockwise", replace(timed, beam_time=None)),
        (None, at_once),
    ]
    if drive.seed % 2:
        mirrored = timed.points * np.float32([1.0, -1.0, 1.0])
        cases.append(("clockwise", replace(timed, points=mirrored, beam_time=None)))
    return [
        Answer(drive.speed, true, spin_estimation.estimate_spin(recording, SlamOptions()))
        for true, recording in cases
    ]


def _table(answers: list[Answer]) -> str:
    lines = []
    for low, high in pairwise(_BOUNDS):
        some = [one for one in answers if low <= one.speed < high]
        spun, still = ([a for a in some if (a.true is None) == none] for none in (False, True))
        right = sum(one.found == one.true for one in spun)
        wrong = sum(one.found not in (None, one.true) for one in spun)
        refused = sum(one.found is not None for one in still)
        counts = (len(spun), right, wrong, len(still), refused)
        lines.append([f"{low:g} to {high:g}", *map(str, counts)])
    titles = ["m/s", "distorted", "right", "wrong", "at once", "given a direction"]
    return markdown(titles, lines)


def _of_folder(folder: Path) -> Iterator[str]:
    recording = stillmap.read(folder)
    recording = replace(
        recording,
        beam_time=None,
        source={key: value for key, value in recording.source.items() if key != SPIN_KEY},
    )
    found = spin_estimation.estimate_spin(recording, SlamOptions())
    yield f"{folder.name}: {found}, {_contrasts(recording)}"
    if found is None:
        return
    timed = add_beam_times(recording, found)
    result = stillmap.build(timed, {"mesh.enabled": False})
    corrected = replace(
        deskew_recording(timed, result.poses, SlamOptions()), source=recording.source
    )
    again = spin_estimation.estimate_spin(corrected, SlamOptions())
    yield f"{folder.name}, motion removed: {again}, {_contrasts(corrected)}"


def _contrasts(recording: stillmap.Recording) -> str:
    mean, error = spin_estimation.summarize_contrasts(
        spin_estimation.measure_contrasts(recording, SlamOptions())
    )
    return f"contrast {mean:.4f}, {abs(mean) / error:.1f} standard errors"


if __name__ == "__main__":
    main()
