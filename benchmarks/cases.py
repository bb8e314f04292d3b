"""The simulated runs that benchmarks are made of: which world, which people, which sensor."""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from stillmap.sim import Scene, scene_by_name
from stillmap.sim.options import OdometryOptions

POPULATED = "populated"
STOPS = "everyone stops"
EMPTY = "empty"
SENSORS = "sensors"
ODOMETRY = "odometry"
ONCE = "passed once"  # nothing in the recording shows that these cars move: in no mean
MOVED = "moved"  # things are moved between two visits: run only where it is named
FAST_OR_FAR = "fast or far"  # movers seen for moments: run only where it is named
TRAJECTORY = "trajectory"  # hard for poses, long or both: run only where it is named
GROUPS = (POPULATED, STOPS, EMPTY, SENSORS, ODOMETRY, ONCE, MOVED, FAST_OR_FAR, TRAJECTORY)

Changes = Mapping[str, Any]


@dataclass(frozen=True)
class Case:
    """A world and what differs from its defaults."""

    name: str
    group: str
    scene: str
    changes: Changes = field(default_factory=dict)

    def build(self) -> Scene:
        return scene_by_name(self.scene, self.changes)


def chosen(names: Iterable[str]) -> list[Case]:
    """The cases of these names or groups, in the catalogue's order; no name: those for labels."""
    wanted = set(names)
    unknown = wanted - {case.name for case in CASES} - set(GROUPS)
    if unknown:
        known = ", ".join(case.name for case in CASES)
        raise SystemExit(f"no case {', '.join(sorted(unknown))}; cases: {known}; groups: {GROUPS}")
    if not wanted:
        return [case for case in CASES if case.group not in (MOVED, FAST_OR_FAR, TRAJECTORY)]
    return [case for case in CASES if wanted & {case.name, case.group}]


def _crowd(people: int, shape: str = "mixed", scans: int | None = None) -> dict[str, Any]:
    return {"crowd": {"people": people, "shape": shape}, "robot": {"scans": scans}}


def _part(scans: int | None) -> dict[str, Any]:
    """The first part of the route."""
    return {"robot": {"scans": scans}}


def _sensor(
    beams: int, degrees: float, max_range: float, noise: float, scans: int | None = None
) -> dict[str, Any]:
    """A laser, on part of the route: many beams take as long as many scans."""
    return {
        "laser": {
            "beams": beams,
            "fov": math.radians(degrees),
            "max_range": max_range,
            "range_noise": noise,
        },
        **_part(scans),
    }


def scaled_odometry(factor: float, **more: float) -> dict[str, Any]:
    """Errors and noise of the wheels, times a factor."""
    defaults = dataclasses.asdict(OdometryOptions())
    scaled = {
        name: factor * value
        for name, value in defaults.items()
        if name.endswith(("error", "noise"))
    }
    return {"odometry": {**scaled, **more}}


def few_walls(people: int) -> dict[str, Any]:
    """A hall whose laser sees hardly more than what stands about in it."""
    return {"crowd": {"people": people}, "laser": {"max_range": 8.0}}


_SLIPS = scaled_odometry(1.0, slip_rate=0.05)
_EVERYONE_STOPS = {"crowd": {"stopping_share": 1.0, "min_stop": 15.0, "max_stop": 60.0}}

CASES = (
    Case("hall-15", POPULATED, "hall"),
    Case("hall-15-legs", POPULATED, "hall", _crowd(15, "legs", 1200)),
    Case("hall-30-bodies", POPULATED, "hall", _crowd(30, "bodies", 1200)),
    Case("hall-60", POPULATED, "hall-crowd"),
    Case("hall-80", POPULATED, "hall-crowd", _crowd(80, scans=1200)),
    Case("corridor-5", POPULATED, "corridor", _crowd(5, "legs")),
    Case("corridor-20", POPULATED, "corridor"),
    Case("corridor-40", POPULATED, "corridor-crowd"),
    Case("office-10", POPULATED, "office"),
    Case("office-25-bodies", POPULATED, "office", _crowd(25, "bodies")),
    Case("warehouse-12", POPULATED, "warehouse"),
    Case("warehouse-30-legs", POPULATED, "warehouse", _crowd(30, "legs", 1200)),
    Case("street-16", POPULATED, "street"),
    Case("hall-stops", STOPS, "hall", _EVERYONE_STOPS),
    Case("corridor-stops", STOPS, "corridor", _EVERYONE_STOPS),
    Case("office-stops", STOPS, "office", _EVERYONE_STOPS),
    Case("hall-empty", EMPTY, "hall-empty", _part(1200)),
    Case("corridor-empty", EMPTY, "corridor-empty", _part(1200)),
    Case("office-empty", EMPTY, "office-empty"),
    Case("warehouse-empty", EMPTY, "warehouse-empty", _part(1200)),
    Case("street-empty", EMPTY, "street-empty"),
    Case("street-turn-empty", EMPTY, "street-turn-empty"),
    Case("hall-90deg", SENSORS, "hall", _sensor(181, 90, 30, 0.01, 1200)),
    Case("corridor-270deg-1081", SENSORS, "corridor", _sensor(1081, 270, 30, 0.03, 500)),
    Case("office-360deg-12m", SENSORS, "office", _sensor(360, 360, 12, 0.02, 900)),
    Case("hall-360deg-1440-5cm", SENSORS, "hall", _sensor(1440, 360, 25, 0.05, 350)),
    Case("corridor-270deg-5m", SENSORS, "corridor", _sensor(541, 270, 5, 0.01, 1000)),
    Case("hall-361-80m-5cm", SENSORS, "hall", _sensor(361, 180, 80, 0.05, 800)),
    Case("corridor-5cm", SENSORS, "corridor", _sensor(181, 180, 30, 0.05, 1200)),
    Case("corridor-good-odometry", ODOMETRY, "corridor", scaled_odometry(0.3)),
    Case("corridor-bad-odometry", ODOMETRY, "corridor", scaled_odometry(3.0)),
    Case("hall-bad-odometry", ODOMETRY, "hall", {**scaled_odometry(3.0), **_part(1200)}),
    Case("office-slips", ODOMETRY, "office", _SLIPS),
    Case("warehouse-slips", ODOMETRY, "warehouse", {**_SLIPS, **_part(1200)}),
    Case("street-turn", ONCE, "street-turn"),
    Case("office-moved", MOVED, "office-moved"),
    Case("street-moved", MOVED, "street-moved"),
    Case("warehouse-moved", MOVED, "warehouse-moved"),
    Case("street-oncoming", FAST_OR_FAR, "street-oncoming"),
    Case("street-oncoming-361-40m", FAST_OR_FAR, "street-oncoming", _sensor(361, 180, 40, 0.02)),
    Case("street-oncoming-720", FAST_OR_FAR, "street-oncoming", _sensor(720, 360, 60, 0.02)),
    Case("corridor-40-once", FAST_OR_FAR, "corridor-crowd", _part(600)),
    Case("corridor-40-once-legs", FAST_OR_FAR, "corridor-crowd", _crowd(40, "legs", 600)),
    Case("hall-180", FAST_OR_FAR, "hall-crowd", _crowd(180, scans=900)),
    Case("corridor-20-legs", FAST_OR_FAR, "corridor", _crowd(20, "legs")),
    Case("corridor-20-4hz", FAST_OR_FAR, "corridor", {"robot": {"scan_rate": 4.0}}),
    Case("hall-8m", TRAJECTORY, "hall", few_walls(20)),
    Case("hall-8m-empty", TRAJECTORY, "hall", few_walls(0)),
    Case("drive-75hz", TRAJECTORY, "drive", {}),
    Case("drive-10hz", TRAJECTORY, "drive", {"robot": {"scan_rate": 10.0}}),
    Case("rounds", TRAJECTORY, "rounds"),
    Case("rounds-empty", TRAJECTORY, "rounds-empty"),
    Case("ten-corridors", TRAJECTORY, "ten-corridors"),
    Case("ten-corridors-bad-odometry", TRAJECTORY, "ten-corridors", scaled_odometry(3.0)),
    Case("office-carried", TRAJECTORY, "office", {"robot": {"carried_at": 0.5}}),
    Case("warehouse-carried", TRAJECTORY, "warehouse", {"robot": {"carried_at": 0.5}}),
    Case("office-resets", TRAJECTORY, "office", {"odometry": {"resets": 4}}),
    Case("office-stalls", TRAJECTORY, "office", {"odometry": {"stall_rate": 1.0}}),
    Case("office-two-lasers", TRAJECTORY, "office", {"laser": {"second_laser": True}}),
    Case("office-backwards", TRAJECTORY, "office", {"laser": {"yaw": math.pi}}),
    Case("office-bad-odometry", TRAJECTORY, "office", scaled_odometry(3.0)),
)
