"""Simulate a robot in a place with moving people, doors and cars, and write its recording with the
truth. Options that are not given are those of the scene.

scenes:
  building         one floor of eight wings, 14 people
  corridor         a loop of 36 x 22 m, 20 people
  corridor-crowd   the same with 40 people
  crossing         two streets of 180 m, lights, old trees, a park, 16 cars, 30 pedestrians
  drive            970 m by car, with a red light
  gallery          28 x 18 m, mirrors and glass, 8 people
  hall             45 x 30 m, 15 people
  hall-crowd       the same with 60 people
  lookalike-1      a corridor of 40 m, 4 people
  lookalike-2      another one of the same shape with other rooms
  office           40 x 25 m, 22 doors, 10 people
  office-moved     things are moved between two visits
  rounds           197 x 82 m, corridors around six courtyards, 40 people
  street           180 m, there and back, 14 cars, 16 pedestrians
  street-jam       the street with lights and a queue; everybody stops at times
  street-moved     parked cars drive off, others park
  street-oncoming  260 m of a bending road, one way, 16 cars that come towards the robot
  street-turn      185 m, one way, waiting and driving cars
  ten-corridors    56 x 37 m, corridors of the same shape
  two-wings        two such corridors that share a door, 6 people
  warehouse        50 x 30 m, 12 people, 2 forklifts
  warehouse-moved  racks are emptied and filled overnight
  NAME-empty       any but the -crowd ones, without people and vehicles

examples:
  stillmap simulate hall -o sim
  stillmap simulate corridor -o sim --people 40 --scans 500 --seed 7
  stillmap simulate street -o sim --set traffic.vehicles=3 --json
  stillmap simulate street -o sim --lidar 64 --scans 300 --set lidar.vibration_pitch=0.005
  stillmap simulate hall -o sim --lidar tilting --rate 37.5 --scans 900 --camera
  stillmap simulate office -o days --sessions 5 --seed 3
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.cli.arguments import JSON, OVERWRITE, make_parents
from stillmap.cli.console import list_files, print_json, say, show_share
from stillmap.core.errors import InputError

if TYPE_CHECKING:
    from stillmap.sim import Scene


FLAGS = f"""
scene SCENE  one of those listed below
-o --output DIR!  folder for recording and truth
{OVERWRITE}
--sessions N  N recordings of the place on as many days: things are moved, brought and taken in
  between, routes, starts and mounts differ
--seed N = 0  seed of the random numbers
{JSON}
people:
--people N -> crowd.people  number of people
--stopping P -> crowd.stopping_share  share of people who stop at times
--min-stop S -> crowd.min_stop  shortest stop, seconds
--max-stop S -> crowd.max_stop  longest stop, seconds
--shape SHAPE -> crowd.shape  shape of people in a scan: legs, bodies or mixed

robot:
--scans N -> robot.scans  number of scans; the route is repeated
--rate HZ -> robot.scan_rate  scans per second
--carried-at P -> robot.carried_at  when the robot is carried, 0 to 1
--stamp-rounding S -> robot.stamp_rounding  resolution of stamps, seconds

laser:
--beams N -> laser.beams  beams per scan
--fov DEG -> laser.fov  field of view in degrees
--max-range M -> laser.max_range  range of the laser, metres
--range-noise M -> laser.range_noise  standard deviation of ranges, metres
--sweep-time S -> laser.sweep_time  duration of a scan, seconds
--second-laser -> laser.second_laser  a second laser that looks backwards
--lidar N|tilting  a spinning lidar of N channels instead, in 3D; 'tilting': a second laser that
  tilts
--camera -> camera.enabled  cameras, with --lidar; their images show static and moving things

odometry:
--slip-rate X -> odometry.slip_rate  wheel slips per metre driven
--stall-rate X -> odometry.stall_rate  odometry stalls per minute
--resets N -> odometry.resets  number of resets of odometry to its origin
--odometry-noise X = 1.0  factor on the default errors of odometry; 0: perfect

any other option of the scene, see docs/simulation.md:
--set SECTION.KEY=VALUE... -> assignments  e.g. traffic.vehicles=3; can be given again
"""
# options of the laser that a lidar has too, and its own
_LIDAR_KEYS = (
    ("laser.max_range", "lidar.max_range"),
    ("laser.range_noise", "lidar.range_noise"),
    ("robot.scan_rate", "lidar.rate"),
)
_NOISES = "wheel_radius_error wheel_base_error translation_noise rotation_noise drift_noise"


def run(args: argparse.Namespace) -> int:
    """Simulate, and write recording and truth.

    Raises:
        InputError: unknown scene, a value out of range, or a folder that is in the way.
    """
    from stillmap.core.config import merge_nested, nest, parse_assignment
    from stillmap.sim import scene_by_name

    if args.seed < 0:
        raise InputError(f"--seed must not be negative, got {args.seed}")
    changes = merge_nested(*map(parse_assignment, args.assignments), nest(_flag_changes(args)))
    scene = scene_by_name(args.scene, changes)
    output = Path(args.output)
    with make_parents(output):
        counts = _simulate(scene, args, output)
    keys = ("beams", "hits", "dynamic", "scans")
    total = {key: sum(count[key] for count in counts) for key in keys}
    if scene.rig.tilts:  # both lasers scan at the same time
        total["scans"] = counts[0]["scans"]
    if not args.quiet:
        share = 100 * total["dynamic"] / max(total["hits"], 1)
        size = f"{total['scans']} scans, {total['beams']} beams"
        say(f"wrote {output}: {scene.name}, {size}, {share:.1f} % of the hits on movers")
    if args.json:
        sessions = {} if args.sessions is None else {"sessions": counts}
        summary = {"output": str(output), "files": list_files(output), "scene": scene.name}
        print_json({**summary, **total, **sessions})
    return 0


def _simulate(scene: "Scene", args: argparse.Namespace, output: Path) -> list[dict[str, Any]]:
    """Simulate and write; returns the counts of each recording."""
    from stillmap.core.files import require_new, workplace
    from stillmap.sim import sessions, simulate, simulator

    if args.sessions is not None:
        require_new(output, sessions.SESSIONS_MARK, args.overwrite)
        plan = sessions.plan_sessions(scene, args.sessions, args.seed)
        with show_share(args.quiet, "simulating") as progress:
            return sessions.write_sessions(
                [plan], output, seed=args.seed, overwrite=args.overwrite, tell=progress
            )
    require_new(output, simulator.find_marker(scene), args.overwrite)
    with show_share(args.quiet, "simulating") as progress:
        made = simulate(scene, args.seed, progress, workplace(output))
    simulator.write_simulation(made, output, overwrite=args.overwrite)
    return [simulator.count_beams(part) for part in made.parts]


def _flag_changes(args: argparse.Namespace) -> dict[str, Any]:
    """Options that flags set, by name."""
    from stillmap.sim import scene_by_name

    changes = {name: value for name, value in vars(args).items() if "." in name}
    changes = {name: value for name, value in changes.items() if value is not None}
    if args.odometry_noise != 1.0:
        usual = scene_by_name(args.scene).odometry
        for key in _NOISES.split():
            changes[f"odometry.{key}"] = args.odometry_noise * getattr(usual, key)
    if args.lidar == "tilting":
        changes["rig.tilts"] = True
    elif args.lidar is not None:
        _move_to_lidar(args.lidar, changes)
    return changes


def _move_to_lidar(channels: str, changes: dict[str, Any]) -> None:
    """Move the changes of the laser to the lidar that takes its place."""
    if not channels.isascii() or not channels.isdigit() or int(channels[:9]) < 1:
        raise InputError(f"--lidar wants a number of channels or 'tilting', got '{channels}'")
    for name, own in _LIDAR_KEYS:
        if name in changes:
            changes[own] = changes.pop(name)
    of_laser = [name for name in changes if name.startswith("laser.")]
    if of_laser:
        hint = "--set lidar.KEY=VALUE, see docs/simulation.md"
        raise InputError(f"a lidar has no {of_laser[0]}", hint=hint)
    changes["lidar.channels"] = int(channels[:9])
