"""`stillmap simulate SCENE`: a recording with truth, for tests and demos."""

import argparse
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.cli.progress import say
from stillmap.errors import InputError
from stillmap.options import merged, parse_assignment
from stillmap.output.atomic import require_new
from stillmap.simulation import SCENES, Simulation, scene_by_name, simulate, write_simulation
from stillmap.simulation.motion import Progress
from stillmap.simulation.writing import require_carmen

# flag, metavar, type, section and key of the option it sets, help
_FLAGS: tuple[tuple[str, str, type, str, str, str], ...] = (
    ("people", "N", int, "crowd", "people", "how many people walk about"),
    ("stopping", "SHARE", float, "crowd", "stopping_share", "share of people who stop at times"),
    ("min-stop", "S", float, "crowd", "min_stop", "the shortest stop, seconds"),
    ("max-stop", "S", float, "crowd", "max_stop", "the longest stop, seconds"),
    ("scans", "N", int, "robot", "scans", "scans to take; the route goes round and round"),
    ("rate", "HZ", float, "robot", "scan_rate", "scans per second"),
    ("beams", "N", int, "laser", "beams", "beams per scan"),
    ("fov", "DEG", float, "laser", "fov", "field of view in degrees"),
    ("max-range", "M", float, "laser", "max_range", "range of the laser, metres"),
    ("range-noise", "M", float, "laser", "range_noise", "standard deviation of ranges, metres"),
    ("sweep-time", "S", float, "laser", "sweep_time", "how long a scan takes, seconds"),
    ("slip-rate", "N", float, "odometry", "slip_rate", "how often wheels slip, per metre driven"),
    ("stall-rate", "N", float, "odometry", "stall_rate", "how often odometry stalls, per minute"),
    ("resets", "N", int, "odometry", "resets", "how often odometry begins again at its origin"),
    ("carried-at", "SHARE", float, "robot", "carried_at", "when the robot is carried elsewhere"),
    ("stamp-rounding", "S", float, "robot", "stamp_rounding", "how coarse stamps are, seconds"),
)
_ODOMETRY_ERRORS = (
    "wheel_radius_error",
    "wheel_base_error",
    "translation_noise",
    "rotation_noise",
    "drift_noise",
)


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Register the command with argparse's `subparsers`."""
    p = subparsers.add_parser(
        "simulate",
        help="a recording with truth, for tests and demos",
        description="Simulate a robot that records a place where people, doors and cars move, and "
        "write what it recorded together with the truth.",
    )
    p.add_argument("scene", metavar="SCENE", help=", ".join(SCENES))
    p.add_argument("-o", "--output", metavar="DIR", required=True, help="where it goes")
    p.add_argument("--overwrite", action="store_true", help="replace what is in DIR")
    p.add_argument("--seed", metavar="N", type=int, default=0, help="another one, another run")
    for flag, metavar, kind, _, _, text in _FLAGS:
        p.add_argument(f"--{flag}", metavar=metavar, type=kind, help=text)
    p.add_argument(
        "--shape", choices=["legs", "bodies", "mixed"], help="what the laser sees of people"
    )
    p.add_argument("--second-laser", action="store_true", help="another one, that looks backwards")
    p.add_argument(
        "--odometry-noise",
        metavar="FACTOR",
        type=float,
        default=1.0,
        help="errors of the odometry against their defaults; 0: perfect odometry",
    )
    p.add_argument(
        "--format",
        choices=["stillmap", "carmen"],
        default="stillmap",
        help="the recording folder, or recording.log with FLASER, RLASER and ODOM lines",
    )
    p.add_argument(
        "--set",
        dest="assignments",
        metavar="SECTION.KEY=VALUE",
        action="append",
        default=[],
        help="any other option of the scene, e.g. traffic.vehicles=3; can be given again",
    )
    p.add_argument("--quiet", action="store_true", help="no progress, no summary")
    p.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Simulate and write; 0 when the folder is there.

    Raises:
        InputError: unknown scene, a value out of range, or a folder that is in the way.
    """
    scene = scene_by_name(args.scene, _changes(args))
    if args.seed < 0:
        raise InputError(f"--seed must not be negative, got {args.seed}")
    if args.format == "carmen":
        require_carmen(scene.laser)
    output = Path(args.output)
    require_new(output, args.overwrite)
    with _shown_progress(args.quiet) as progress:
        simulation = simulate(scene, np.random.default_rng(args.seed), progress)
    write_simulation(simulation, output, format=args.format, overwrite=args.overwrite)
    if not args.quiet:
        say(_summary(simulation, output))
    return 0


def _changes(args: argparse.Namespace) -> dict[str, Any]:
    changes: dict[str, dict[str, Any]] = {}
    for flag, _, _, section, key, _ in _FLAGS:
        value = getattr(args, flag.replace("-", "_"))
        if value is not None:
            changes.setdefault(section, {})[key] = value
    if args.fov is not None:
        changes["laser"]["fov"] = math.radians(args.fov)
    if args.shape is not None:
        changes.setdefault("crowd", {})["shape"] = args.shape
    if args.second_laser:
        changes.setdefault("laser", {})["second_laser"] = True
    if args.odometry_noise != 1.0:
        defaults = scene_by_name(args.scene).odometry
        scaled = {key: args.odometry_noise * getattr(defaults, key) for key in _ODOMETRY_ERRORS}
        changes.setdefault("odometry", {}).update(scaled)
    return merged(*map(parse_assignment, args.assignments), changes)


def _summary(simulation: Simulation, output: Path) -> str:
    recording, truth = simulation.recording, simulation.truth
    hits = int(np.count_nonzero(recording.hit))
    dynamic = int(np.count_nonzero(truth.mover >= 0))
    return (
        f"{simulation.scene.name}: {recording.n_scans} scans, {recording.n_beams} beams, "
        f"{100 * dynamic / max(hits, 1):.1f} % of the hits on movers; in {output}"
    )


@contextmanager
def _shown_progress(quiet: bool) -> Iterator[Progress | None]:
    """A bar on a terminal; elsewhere the summary says enough about a job of seconds."""
    if quiet or sys.stderr is None or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress as Bar

    with Bar(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("simulating", total=1.0)
        yield lambda share: bar.update(task, completed=share)
