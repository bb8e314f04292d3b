"""`stillmap simulate SCENE`: simulate a recording with truth, for tests and demos."""

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.cli.arguments import add_set_flag, make_parents
from stillmap.cli.console import list_files, print_json, say, show_share
from stillmap.core.errors import InputError

if TYPE_CHECKING:
    from stillmap.sim import Scene, Simulation

_SCENES = {
    "hall": "45 x 30 m, 15 people",
    "hall-crowd": "the same with 60 people",
    "corridor": "a loop of 36 x 22 m, 20 people",
    "corridor-crowd": "the same with 40 people",
    "office": "40 x 25 m, 22 doors, 10 people",
    "office-moved": "things are moved between two visits",
    "warehouse": "50 x 30 m, 12 people, 2 forklifts",
    "warehouse-moved": "racks are emptied and filled overnight",
    "gallery": "28 x 18 m, mirrors and glass, 8 people",
    "street": "180 m, there and back, 14 cars, 16 pedestrians",
    "street-moved": "parked cars drive off, others park",
    "street-turn": "185 m, one way, waiting and driving cars",
    "street-jam": "the street with lights and a queue; everybody stops at times",
    "street-oncoming": "260 m of a bending road, one way, 16 cars that come towards the robot",
    "crossing": "two streets of 180 m, lights, old trees, a park, 16 cars, 30 pedestrians",
    "drive": "970 m by car, with a red light",
    "building": "grows with --scans, wing by wing",
    "ten-corridors": "56 x 37 m, corridors of the same shape",
    "rounds": "197 x 82 m, corridors around six courtyards, 40 people",
    "lookalike-1": "a corridor of 40 m, 4 people",
    "lookalike-2": "another one of the same shape with other rooms",
    "two-wings": "two such corridors that share a door, 6 people",
}

_LISTED = "".join(f"  {name:<16} {what}\n" for name, what in _SCENES.items())
DESCRIPTION = (
    "Simulate a robot in a place with moving people, doors and cars, and write its "
    "recording with the truth. Options that are not given are those of the scene."
)
EPILOG = f"""scenes:
{_LISTED}\
  NAME-empty       any but the -crowd ones, without people and vehicles

examples:
  stillmap simulate hall -o sim
  stillmap simulate corridor -o sim --people 40 --scans 500 --seed 7
  stillmap simulate office-empty -o sim --format carmen
  stillmap simulate street -o sim --set traffic.vehicles=3 --json
  stillmap simulate street -o sim --lidar 64 --scans 300 --set lidar.vibration_pitch=0.005
  stillmap simulate hall -o sim --lidar tilting --rate 37.5 --scans 900 --camera
  stillmap simulate office -o days --sessions 5 --seed 3
"""

# flag, metavar, type, section and key of the option it sets, help
_FLAGS: tuple[tuple[str, str, type, str, str, str], ...] = (
    ("people", "N", int, "crowd", "people", "number of people"),
    ("stopping", "SHARE", float, "crowd", "stopping_share", "share of people who stop at times"),
    ("min-stop", "S", float, "crowd", "min_stop", "shortest stop, seconds"),
    ("max-stop", "S", float, "crowd", "max_stop", "longest stop, seconds"),
    ("scans", "N", int, "robot", "scans", "number of scans; the route is repeated"),
    ("rate", "HZ", float, "robot", "scan_rate", "scans per second"),
    ("beams", "N", int, "laser", "beams", "beams per scan"),
    ("fov", "DEG", float, "laser", "fov", "field of view in degrees"),
    ("max-range", "M", float, "laser", "max_range", "range of the laser, metres"),
    ("range-noise", "M", float, "laser", "range_noise", "standard deviation of ranges, metres"),
    ("sweep-time", "S", float, "laser", "sweep_time", "duration of a scan, seconds"),
    ("slip-rate", "N", float, "odometry", "slip_rate", "wheel slips per metre driven"),
    ("stall-rate", "N", float, "odometry", "stall_rate", "odometry stalls per minute"),
    ("resets", "N", int, "odometry", "resets", "number of resets of odometry to its origin"),
    ("carried-at", "SHARE", float, "robot", "carried_at", "when the robot is carried, 0 to 1"),
    ("stamp-rounding", "S", float, "robot", "stamp_rounding", "resolution of stamps, seconds"),
)
# (section, key) of options of the laser that a lidar has too, and its own key
_LIDAR_KEYS = (
    ("laser", "max_range", "max_range"),
    ("laser", "range_noise", "range_noise"),
    ("robot", "scan_rate", "rate"),
)
_GROUPS = {"crowd": "people", "robot": "robot", "laser": "laser", "odometry": "odometry"}
_ODOMETRY_ERRORS = (
    "wheel_radius_error",
    "wheel_base_error",
    "translation_noise",
    "rotation_noise",
    "drift_noise",
)


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the flags and arguments."""
    p.add_argument("scene", metavar="SCENE", help="one of those listed below")
    _add_output_flags(p)
    groups = {section: p.add_argument_group(title) for section, title in _GROUPS.items()}
    for flag, metavar, kind, section, _, text in _FLAGS:
        groups[section].add_argument(f"--{flag}", metavar=metavar, type=kind, help=text)
    groups["crowd"].add_argument(
        "--shape", choices=("legs", "bodies", "mixed"), help="shape of people in a scan"
    )
    groups["laser"].add_argument(
        "--second-laser", action="store_true", help="a second laser that looks backwards"
    )
    groups["laser"].add_argument(
        "--lidar",
        metavar="N",
        help="a spinning lidar of N channels instead, in 3D; 'tilting': a second laser that tilts",
    )
    groups["laser"].add_argument(
        "--camera",
        action="store_true",
        help="cameras, with --lidar; their images show static and moving things",
    )
    groups["odometry"].add_argument(
        "--odometry-noise",
        metavar="FACTOR",
        type=float,
        default=1.0,
        help="factor on the default errors of odometry; 0: perfect (default: %(default)g)",
    )
    others = p.add_argument_group("any other option of the scene, see docs/simulation.md")
    add_set_flag(others, "e.g. traffic.vehicles=3; can be given again")


def _add_output_flags(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "-o", "--output", metavar="DIR", required=True, help="folder for recording and truth"
    )
    p.add_argument("--overwrite", action="store_true", help="replace what is in DIR")
    p.add_argument(
        "--sessions",
        metavar="N",
        type=int,
        help="N recordings of the place on as many days: things are moved, brought and taken in "
        "between, routes, starts and mounts differ",
    )
    p.add_argument(
        "--format",
        choices=("stillmap", "carmen"),
        default="stillmap",
        help="a recording folder, or recording.log with FLASER, RLASER and ODOM lines "
        "(default: %(default)s)",
    )
    p.add_argument(
        "--seed", metavar="N", type=int, default=0, help="seed of the random numbers (default: 0)"
    )
    p.add_argument("--json", action="store_true", help="the summary as one JSON object on stdout")
    p.add_argument("--quiet", action="store_true", help="no progress, no summary")


def run(args: argparse.Namespace) -> int:
    """Simulate, and write recording and truth.

    Raises:
        InputError: unknown scene, a value out of range, or a folder that is in the way.
    """
    import numpy as np

    from stillmap.core.files import require_new, workplace
    from stillmap.sim import scene_by_name, simulate, simulate_rig
    from stillmap.sim.writer import MARK, RIG_MARK, require_carmen, write_rig, write_simulation

    scene = scene_by_name(args.scene, _option_changes(args))
    if args.seed < 0:
        raise InputError(f"--seed must not be negative, got {args.seed}")
    if args.format == "carmen":
        require_carmen(scene)
    output = Path(args.output)
    if args.sessions is not None:
        return _run_sessions(scene, args, output)
    require_new(output, RIG_MARK if scene.rig.tilts else MARK, args.overwrite)
    with make_parents(output):
        with show_share(args.quiet, "simulating") as progress:
            rng, scratch = np.random.default_rng(args.seed), workplace(output)
            if scene.rig.tilts:
                rig = simulate_rig(scene, rng, progress, scratch)
                simulations = [rig.horizontal, rig.tilting]
            else:
                simulations = [simulate(scene, rng, progress, scratch)]
        if scene.rig.tilts:
            write_rig(rig, output, overwrite=args.overwrite)
        else:
            write_simulation(simulations[0], output, format=args.format, overwrite=args.overwrite)
    summary = _summarize(simulations, output)
    if not args.quiet:
        _print_summary(summary)
    if args.json:
        print_json(summary)
    return 0


def _run_sessions(scene: "Scene", args: argparse.Namespace, output: Path) -> int:
    from stillmap.core.files import require_new
    from stillmap.sim.session_truth import MARK
    from stillmap.sim.sessions import SessionOptions, plan_sessions
    from stillmap.sim.writer import write_sessions

    if args.format == "carmen":
        raise InputError("sessions are written as recording folders", hint="no --format carmen")
    if args.sessions < 1:
        raise InputError(f"--sessions wants 1 or more, got {args.sessions}")
    require_new(output, MARK, args.overwrite)
    plan = plan_sessions(scene, SessionOptions(args.sessions), args.seed)
    with make_parents(output), show_share(args.quiet, "simulating") as progress:
        sessions = write_sessions(
            [plan], output, seed=args.seed, overwrite=args.overwrite, tell=progress
        )
    totals = {key: sum(one[key] for one in sessions) for key in ("scans", "beams", "hits")}
    totals["dynamic"] = sum(one["dynamic"] for one in sessions)
    summary = {"output": str(output), "files": list_files(output), "scene": scene.name, **totals}
    summary["sessions"] = sessions
    if not args.quiet:
        _print_summary(summary)
    if args.json:
        print_json(summary)
    return 0


def _option_changes(args: argparse.Namespace) -> dict[str, Any]:
    from stillmap.core.config import merge_nested, parse_assignment
    from stillmap.sim import scene_by_name

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
    if args.camera:
        changes.setdefault("camera", {})["enabled"] = True
    if args.odometry_noise != 1.0:
        defaults = scene_by_name(args.scene).odometry
        scaled = {key: args.odometry_noise * getattr(defaults, key) for key in _ODOMETRY_ERRORS}
        changes.setdefault("odometry", {}).update(scaled)
    if args.lidar == "tilting":
        changes["rig"] = {"tilts": True}
    elif args.lidar is not None:
        _move_to_lidar(args.lidar, changes)
    return merge_nested(*map(parse_assignment, args.assignments), changes)


def _move_to_lidar(channels: str, changes: dict[str, dict[str, Any]]) -> None:
    """Move the changes of the laser to the lidar that takes its place."""
    if not channels.isascii() or not channels.isdigit() or int(channels[:9]) < 1:
        raise InputError(f"--lidar wants a number of channels or 'tilting', got '{channels}'")
    lidar: dict[str, Any] = {"channels": int(channels[:9])}
    for section, key, own in _LIDAR_KEYS:
        if key in changes.get(section, {}):
            lidar[own] = changes[section].pop(key)
    if changes.get("laser"):
        hint = "--set lidar.KEY=VALUE, see docs/simulation.md"
        raise InputError(f"a lidar has no laser.{next(iter(changes['laser']))}", hint=hint)
    changes["lidar"] = lidar


def _summarize(simulations: "list[Simulation]", output: Path) -> dict[str, Any]:
    """Counts over one recording, or over several with the same stamps."""
    from stillmap.core.arrays import iter_blocks

    hits = [one.recording.hit for one in simulations]
    movers = [one.truth.mover for one in simulations]
    return {
        "output": str(output),
        "files": list_files(output),
        "scene": simulations[0].scene.name,
        "scans": simulations[0].recording.n_scans,
        "beams": sum(one.recording.n_beams for one in simulations),
        "hits": sum(int(hit[part].sum()) for hit in hits for part in iter_blocks(hit)),
        "dynamic": sum(
            int((mover[part] >= 0).sum()) for mover in movers for part in iter_blocks(mover)
        ),
    }


def _print_summary(summary: dict[str, Any]) -> None:
    share = 100 * summary["dynamic"] / max(summary["hits"], 1)
    say(
        f"wrote {summary['output']}: {summary['scene']}, {summary['scans']} scans, "
        f"{summary['beams']} beams, {share:.1f} % of the hits on movers"
    )
