"""Sessions: recordings of one world on different days, between which things change; their truth."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stillmap.core.array_folder import FORMAT_VERSION
from stillmap.core.array_types import Float
from stillmap.core.errors import InputError
from stillmap.core.files import atomic_folder
from stillmap.core.json import write_json
from stillmap.sim.dynamics import faces_at_all_places
from stillmap.sim.options import HeightOptions
from stillmap.sim.planner import FreeSpace, Planner
from stillmap.sim.scene import Point, Scene
from stillmap.sim.session_layout import Layout, StandingObject
from stillmap.sim.simulator import Simulation, count_beams, simulate, write_folder
from stillmap.sim.world_3d import make_parts, trace_loops

SESSIONS_FILE = "sessions.json"
SESSIONS_MARK = "session-1/truth"  # every folder of simulated sessions has it, no place does
_MARGIN = 0.15  # m between the robot's footprint and walls, as along its route
_CANDIDATES = 24  # random points, the farthest of which from all visited ones comes next
_MAX_LEG = 18.0  # m between one point of a tour and the next, as the crow flies
_MAX_POINTS = 400  # of a tour
_VIA = 8.0  # m between the points of a piece of a street
_MAX_ASIDE = 0.5  # m, by which a car drives beside the route
_SECONDS = 200.0  # of a session, unless the number of scans is given
_SECONDS_3D = 12.0  # the same with a lidar
_MIN_SPEED = 0.8  # m/s, of the robot indoors, so that a session shows much of the place
_DAY = 86_400  # s

DrawRoute = Callable[[Scene, float, np.random.Generator], Scene]


class SessionPlan(NamedTuple):
    """The scenes of S sessions.

    Attributes:
        name: of the world.
        scenes: one of each session; its things are the objects that are there, in order.
        objects: everything that may change; a scene's things are those present, in this order.
        first_stamp_ns: (S,) when each begins.
        seeds: (S,) of each simulation.
    """

    name: str
    scenes: tuple[Scene, ...]
    objects: tuple[StandingObject, ...]
    first_stamp_ns: tuple[int, ...]
    seeds: tuple[int, ...]


def plan_sessions(
    scene: Scene,
    count: int,
    seed: int = 0,
    *,
    routes: Sequence[DrawRoute] = (),
    has_odd_sensor: bool = True,
) -> SessionPlan:
    """Plan the sessions of a world: what stands where, routes, mounts, times.

    With one more session, the former ones stay as they are, but for the odd sensor.

    Args:
        scene: the world; its doors get a constant angle in each session.
        count: number of sessions.
        seed: of everything, the simulations too.
        routes: of each session, gives a scene a route of some metres; none: `draw_piece`
            of a street, `draw_tour` indoors.
        has_odd_sensor: one session has half the beams or a narrower field of view.

    Raises:
        InputError: the world cannot be recorded in sessions, or the robot finds no room.
    """
    if count < 1:
        raise InputError(f"the number of sessions must be 1 or more, got {count}")
    if scene.things:
        hint = "the same world without '-moved'"
        raise InputError(f"the things of '{scene.name}' move within a recording", hint=hint)
    if scene.rig.tilts or scene.camera.enabled or scene.robot.pause_at is not None:
        raise InputError("sessions have one laser or lidar, no camera and no pause")
    layout_rng, *rngs = np.random.default_rng(seed).spawn(1 + count)
    odd = 0
    if has_odd_sensor and count > 1:
        odd = int(np.random.default_rng([seed, count]).integers(1, count))
    layout = Layout(scene, layout_rng)
    for _ in range(1, count):
        layout.add_session()
    scenes, stamps = [], []
    for session, rng in enumerate(rngs):
        things = tuple(filter(None, (item.thing(session) for item in layout.objects)))
        base = replace(scene, walls=layout.walls, leaves=(), lights=(), things=things)
        usual = draw_piece if _is_drive(scene) else draw_tour
        base = _send_robot(base, routes[session] if routes else usual, rng)
        scenes.append(_mount_sensor(base, 0 < session == odd, rng))
        stamps.append((session * _DAY + int(rng.integers(0, _DAY // 3))) * 10**9)
    seeds = tuple(int(rng.integers(1 << 31)) for rng in rngs)
    return SessionPlan(scene.name, tuple(scenes), layout.objects, tuple(stamps), seeds)


def simulate_sessions(plan: SessionPlan) -> Iterator[Simulation]:
    """Simulate one session after the other.

    Each truth has `thing`: the index of the object of the plan that each beam hit, or -1.

    Raises:
        InputError: no room for the robot or the people.
    """
    for session, (scene, seed) in enumerate(zip(plan.scenes, plan.seeds, strict=True)):
        made = simulate(scene, seed)
        recording, truth = made.recording, made.truth
        recording = replace(recording, stamp_ns=recording.stamp_ns + plan.first_stamp_ns[session])
        thing = np.full(len(truth.mover), -1, np.int32) if truth.thing is None else truth.thing
        present = [k for k, item in enumerate(plan.objects) if item.places[session] is not None]
        which = np.array([*present, -1], np.int32)  # -1 stays -1
        yield replace(made, recording=recording, truth=replace(truth, thing=which[thing]))


def write_sessions(
    plans: Sequence[SessionPlan],
    path: str | Path,
    *,
    seed: int = 0,
    overwrite: bool = False,
    tell: Callable[[float], None] | None = None,
) -> list[dict[str, Any]]:
    """Simulate sessions and write them into one folder that appears complete or not at all.

    Args:
        plans: most often one; sessions of several plans are those of different places.
        path: the folder: session-1, session-2 ... and sessions.json.
        seed: of the plan, for the record.
        overwrite: replace earlier sessions.
        tell: called with the completed share.

    Returns:
        Of each session its name and numbers of scans, beams, hits and hits on movers.

    Raises:
        InputError: no room for robot or people, or the folder holds something already.
    """
    total = sum(len(plan.scenes) for plan in plans)
    about: list[dict[str, Any]] = []
    counts: list[dict[str, Any]] = []
    with atomic_folder(Path(path), SESSIONS_MARK, overwrite) as work:
        for place, plan in enumerate(plans):
            for simulation in simulate_sessions(plan):
                name = f"session-{len(about) + 1}"
                (work / name).mkdir()
                write_folder(simulation, work / name)
                about.append({"name": name, "place": place, **_describe(simulation)})
                counts.append({"name": name, **count_beams(simulation)})
                if tell is not None:
                    tell(len(about) / total)
        objects, scene = plans[0].objects if len(plans) == 1 else (), plans[0].scenes[0]
        changes = list_changes(objects, scene.heights if scene.in_3d else None)
        tree = {
            "format_version": FORMAT_VERSION,
            "scene": [plan.name for plan in plans],
            "seed": seed,
            "sessions": about,
            "objects": [
                {"id": k, "kind": o.kind, "changed": o.is_changed, "faces": o.faces, "at": o.places}
                for k, o in enumerate(objects)
            ],
            "changes": [change.to_dict(k, counts) for k, change in enumerate(changes)],
        }
        write_json(work / SESSIONS_FILE, tree)
    return counts


def _describe(simulation: Simulation) -> dict[str, Any]:
    scene, recording = simulation.scene, simulation.recording
    sensor = scene.lidar if scene.in_3d else scene.laser
    return {
        "T_world_session": simulation.truth.T_world_base[0],
        "first_stamp_ns": int(recording.stamp_ns[0]),
        "scans": recording.n_scans,
        "beams_per_scan": scene.lidar.columns if scene.in_3d else scene.laser.beams,
        "fov": 2 * np.pi if scene.in_3d else scene.laser.fov,
        "mount": [sensor.x, sensor.y, sensor.yaw],
    }


class TrueChange(NamedTuple):
    """A change between two successive sessions.

    Attributes:
        object: index of the object.
        kind: "appeared", "gone", "moved" or "door".
        box: x0, y0, x1, y1 in metres and in 3D z0, z1; where it is now, or was.
        from_box: where it was, of what moved and of doors.
        between: the last session before and the first one after.
    """

    object: int
    kind: str
    box: tuple[float, ...]
    from_box: tuple[float, ...] | None
    between: tuple[int, int]

    def to_dict(self, number: int, sessions: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """As JSON; `number`: its id."""
        tree = {key: value for key, value in self._asdict().items() if value is not None}
        return {"id": number, **tree, "between": [sessions[k]["name"] for k in self.between]}


def list_changes(
    objects: Sequence[StandingObject], heights: HeightOptions | None
) -> list[TrueChange]:
    """The changes between successive sessions, in order.

    Args:
        objects: with their places in each session.
        heights: of a 3D world, for z; None: in 2D.
    """
    changes = []
    for after in range(1, len(objects[0].places) if objects else 0):
        for number, item in enumerate(objects):
            if item.places[after - 1] == item.places[after]:
                continue
            was, now = (_box_around(item, session, heights) for session in (after - 1, after))
            kind = "moved" if was and now else "gone" if was else "appeared"
            kind = "door" if item.kind == "door" else kind
            from_box = (was if now else None) or None
            changes.append(TrueChange(number, kind, now or was, from_box, (after - 1, after)))
    return changes


def _box_around(
    item: StandingObject, session: int, heights: HeightOptions | None
) -> tuple[float, ...]:
    """x0, y0, x1, y1 of the box around an object and in 3D z0, z1; empty while it is absent."""
    if item.places[session] is None:
        return ()
    ends = item.faces_in(session).reshape(-1, 2)
    box = (*ends.min(axis=0).tolist(), *ends.max(axis=0).tolist())
    if heights is None:
        return box
    loops, _ = trace_loops(item.faces)
    tops = [part.z[1] for loop in loops for part in make_parts(loop, heights)]
    return (*box, 0.0, max(tops, default=heights.furniture))


def _send_robot(scene: Scene, give_route: DrawRoute, rng: np.random.Generator) -> Scene:
    """The scene with a route and a number of scans."""
    speed = scene.robot.speed if _is_drive(scene) else max(_MIN_SPEED, scene.robot.speed)
    seconds = _SECONDS_3D if scene.in_3d else _SECONDS
    scans = scene.robot.scans or round(seconds * scene.scan_rate)
    scene = give_route(scene, speed * scans / scene.scan_rate, rng)
    people_at = scene.people_at or scene.route[:1]
    robot = replace(scene.robot, speed=speed, scans=scans)
    return replace(scene, people_at=people_at, robot=robot)


def _mount_sensor(scene: Scene, is_odd: bool, rng: np.random.Generator) -> Scene:
    """The scene with a mount of its own; odd: half the beams or a narrower field of view."""
    x, y, yaw = rng.uniform((-0.1, -0.1, -0.4), (0.2, 0.1, 0.4)).tolist()
    narrow = rng.random() < 0.5
    laser, lidar = scene.laser, scene.lidar
    laser = replace(laser, x=laser.x + x, y=laser.y + y, yaw=laser.yaw + yaw)
    lidar = replace(lidar, x=lidar.x + x, y=lidar.y + y, yaw=lidar.yaw + yaw)
    if is_odd:
        fov, share = (0.75, 0.75) if narrow else (1.0, 0.5)
        beams = max(2, round(laser.beams * share))
        laser = replace(laser, fov=laser.fov * fov, beams=beams)
        lidar = replace(lidar, columns=max(4, lidar.columns // 2))
    return replace(scene, laser=laser, lidar=lidar)


def _is_drive(scene: Scene) -> bool:
    """True for a car, which keeps to the street."""
    return scene.robot.radius > 0.5


def draw_tour(
    scene: Scene, length: float, rng: np.random.Generator, anchors: Float | None = None
) -> Scene:
    """A random tour of `length` metres, from any place to points far from all visited so far.

    Args:
        scene: the world with everything that stands in it.
        length: metres, at least.
        rng: generator.
        anchors: (K, 2) points, the robot stays in the largest part of free space that one of them
            lies in; None: the world's route.

    Raises:
        InputError: the robot finds no room.
    """
    parts = find_free_parts(scene, np.array(scene.route, float) if anchors is None else anchors)
    if not parts:
        raise InputError("the robot finds no room for a tour", hint="another seed or region")
    planner = max(parts, key=lambda part: len(part.nodes))
    nodes = planner.point(planner.nodes)
    at = nodes[rng.integers(len(nodes))]
    tour, visited, driven = [at], at[None], 0.0
    while driven < length and len(tour) < _MAX_POINTS:
        goal = _next_goal(at, visited, nodes, rng)
        way = planner.path(at, planner.node(goal))
        legs = np.concatenate([at[None], way])
        driven += float(np.hypot(*np.diff(legs, axis=0).T).sum())
        tour += list(way)
        visited, at = np.concatenate([visited, way]), way[-1]
    return replace(scene, route=_to_points(tour))


def _next_goal(at: Float, visited: Float, nodes: Float, rng: np.random.Generator) -> Float:
    """A node not too far away, and far from all that were visited."""
    some = nodes[rng.integers(len(nodes), size=_CANDIDATES)]
    away = np.hypot(*(some - at).T)
    near = (away > 1.0) & (away < _MAX_LEG)
    if near.any():
        some = some[near]
    gap = np.hypot(*(some[:, None] - visited).transpose(2, 0, 1)).min(axis=1)
    return np.asarray(some[gap.argmax()])


def find_free_parts(scene: Scene, anchors: Float) -> list[Planner]:
    """Planners of the parts of a world's free space that points (K, 2) lie in."""
    things = faces_at_all_places(scene.things)
    solid = np.array([*scene.walls, *scene.glass, *scene.mirrors, *scene.kerbs, *things], float)
    space = FreeSpace(solid)
    parts: list[Planner] = []
    for anchor in anchors:
        try:
            if not any(part.contains(anchor) for part in parts):
                parts.append(Planner(space, anchor, scene.robot.radius + _MARGIN))
        except InputError:  # something stands there
            continue
    return parts


def draw_piece(
    scene: Scene, length: float, rng: np.random.Generator, begin: float | None = None
) -> Scene:
    """A piece of a street's route of `length` metres, or all of it, a little to the side.

    Args:
        scene: the world.
        length: metres.
        rng: generator.
        begin: metres along the route; None: random.
    """
    line = np.array(scene.route, float)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    room = max(0.0, along[-1] - length)
    begin = room * rng.random() if begin is None else min(max(begin, 0.0), room)
    end = min(begin + length, along[-1])
    aside = rng.uniform(-_MAX_ASIDE, _MAX_ASIDE)
    corners = along[(along > begin + 1.0) & (along < end - 1.0)]
    at = np.unique(np.concatenate([np.arange(begin, end, _VIA), corners, [end]]))
    points = np.column_stack([np.interp(at, along, line[:, k]) for k in (0, 1)])
    heading = np.gradient(points, axis=0)
    heading /= np.maximum(np.hypot(*heading.T), 1e-9)[:, None]
    points += aside * np.column_stack([-heading[:, 1], heading[:, 0]])
    return replace(scene, route=_to_points(points))


def _to_points(points: Sequence[Float] | Float) -> tuple[Point, ...]:
    return tuple((float(x), float(y)) for x, y in points)
