"""A flat that a robot records on several days, small enough to be merged in a second."""

import dataclasses
from pathlib import Path

import numpy as np

import stillmap
from stillmap.sim import Scene, simulate, write_simulation
from stillmap.sim.options import CrowdOptions, LaserOptions, RobotOptions
from stillmap.sim.walls import box

OPTIONS = {"threads": 1, "em.max_iterations": 2}
# a chest comes after the first day, and stays
CHEST = box(0.5, 2.5, 0.8, 0.8)
ROUTES = {
    "day1": ((-5.0, 0.0), (-1.0, 0.0), (3.0, 0.0), (5.0, 0.5)),
    "day2": ((5.0, 0.0), (2.0, 0.3), (-1.0, -0.2), (-5.0, -0.5)),
    "day3": ((-5.0, 0.5), (0.0, 0.5), (5.0, 0.0)),
}
_DAY_NS = 86_400 * 10**9
_WALLS = (
    *box(0, 0, 12, 8),
    *box(-3, 1.5, 1.0, 1.4),
    *box(1.5, -2.2, 0.6, 1.2),
    *box(3.5, 1.8, 1.6, 0.5),
    *box(-4.2, -2.6, 0.8, 0.8),
)


def record_days(folder: Path) -> None:
    """Write a recording of each day: 100 scans of 360 beams."""
    for seed, (day, route) in enumerate(ROUTES.items(), start=1):
        scene = Scene(
            "flat",
            walls=(*_WALLS, *(() if day == "day1" else CHEST)),
            route=route,
            crowd=CrowdOptions(people=1),
            laser=LaserOptions(beams=360, range_noise=0.01, max_range=12.0),
            robot=RobotOptions(scans=100),
        )
        made = simulate(scene, np.random.default_rng(seed))
        later = made.recording.stamp_ns + seed * _DAY_NS
        recording = dataclasses.replace(made.recording, stamp_ns=later)
        write_simulation(dataclasses.replace(made, recording=recording), folder / day)


def record_elsewhere(path: Path) -> None:
    """Write a recording of a long hall that looks like nothing in the flat."""
    scene = Scene(
        "elsewhere",
        walls=(*box(0, 0, 30, 3), *box(4, 0.9, 3.0, 0.3)),
        route=((-13.0, -0.5), (13.0, -0.5)),
        crowd=CrowdOptions(people=0),
        laser=LaserOptions(beams=180, range_noise=0.01, max_range=12.0),
        robot=RobotOptions(scans=40),
    )
    write_simulation(simulate(scene, np.random.default_rng(9)), path)


def map_days(folder: Path) -> None:
    """Record the days into `day1`, ..., and map them into `map1`, ..."""
    record_days(folder)
    for day in ROUTES:
        out = folder / day.replace("day", "map")
        stillmap.build(folder / day, OPTIONS).save(out)


def list_files(folder: Path) -> set[str]:
    """The paths of all files below a folder, relative to it."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def files_of(folder: Path) -> dict[str, bytes]:
    """The content of all files below a folder, by their paths."""
    return {name: (folder / name).read_bytes() for name in sorted(list_files(folder))}
