"""Recordings in space for benchmarks: simulated, or folders that others labelled.

Every case becomes a folder with what all methods are given: the recording itself for stillmap, and
its points without the motion during sweeps, at the poses given, for the others.
"""

import itertools
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import stillmap
from stillmap import slam
from stillmap.sim import scene_by_name, simulate, write_simulation
from stillmap.sim.truth import Truth, load_truth

Float = NDArray[np.float64]

WORLDS = ("street", "street-jam", "crossing", "street-turn", "hall", "corridor", "office")
NEAREST, FARTHEST = 2.5, 50.0  # m: nearer is the car itself, farther nobody is judged
NOBODY = "static"
LASTING = ("door", "thing")  # stand still for so long that they may be seen in one state only
_STOOD, _FACED = 0.5, 0.2  # m, rad: who moves less while he is met stands still
_MOVING, _STATIC = 252, 9  # labels of SemanticKITTI; all others are not scored


@dataclass(frozen=True)
class Case:
    """A simulated run, or a folder that is there already.

    Attributes:
        name: of the world, or of the folder.
        changes: of the world's options; None: nothing is simulated.
        seed: of the simulation.
        folder: of sweeps with labels; None for simulated ones.
    """

    name: str
    changes: dict[str, Any] | None
    seed: int
    folder: Path | None = None


@dataclass(frozen=True, eq=False)
class Known:
    """The truth of beams.

    Attributes:
        static: (M,) whether each met something that stands still for good.
        kind: (M,) number of what it met in `kinds`.
        scored: (M,) whether that counts: it is known, and not the robot itself.
        kinds: names of what moves, then NOBODY.
        rested: (M,) whether what it met was there all the time, and at rest from the first scan to
            the last that met it: that it moves is at most seen from its place being empty
            otherwise. Not known of labels in files: never.
    """

    static: NDArray[np.bool_]
    kind: NDArray[np.int16]
    scored: NDArray[np.bool_]
    kinds: list[str]
    rested: NDArray[np.bool_]


def simulated(
    worlds: Iterable[str],
    channels: Iterable[int],
    seeds: Iterable[int],
    scans: int,
    lidar: Mapping[str, Any],
) -> list[Case]:
    """Every world seen by every lidar, with every seed."""
    return [
        Case(
            f"{world}, {n}",
            {"lidar": {"channels": n, **lidar}, "robot": {"scans": scans}},
            seed,
        )
        for world, n, seed in itertools.product(worlds, channels, seeds)
    ]


def prepare(case: Case, work: Path) -> dict[str, Any]:
    """Writes what methods are given into a new folder; how much that is."""
    work.mkdir(parents=True)
    if case.changes is not None:
        scene = scene_by_name(case.name.split(",")[0], case.changes)
        write_simulation(simulate(scene, case.seed), work / "recording")
        source = work / "recording"
    elif case.folder is not None:
        source = case.folder.resolve()
    else:
        raise ValueError(f"{case.name}: neither simulated nor there")
    recording = stillmap.read(source)
    if case.folder is None:
        truth = load_truth(source)
        poses, known = truth.T_world_base, known_of(truth, recording.offset)
    else:
        poses, known = lidar_poses(source / "poses_lidar.txt"), labelled(source / "labels")
    if len(known.static) != recording.n_beams or len(poses) != recording.n_scans:
        raise SystemExit(f"{source}: labels or poses are not those of its sweeps")
    np.save(work / "poses.npy", poses)
    (work / "case.json").write_text(json.dumps({"source": str(source), "kinds": known.kinds}))
    beam, near = write_given(work, recording, poses)
    np.save(work / "beam.npy", beam)
    np.save(work / "static.npy", known.static[beam])
    np.save(work / "kind.npy", known.kind[beam])
    np.save(work / "rested.npy", known.rested[beam])
    np.save(work / "scored.npy", known.scored[beam] & near)
    return {"sweeps": recording.n_scans, "beams": recording.n_beams, "given": len(beam)}


def known_of(truth: Truth, offset: NDArray[np.int64]) -> Known:
    """The truth of a simulation whose scans t have the beams offset[t] to offset[t + 1]."""
    of_movers = list(truth.scene["mover_kinds"])
    kinds = [*dict.fromkeys(of_movers), NOBODY]
    number = np.array([*(kinds.index(k) for k in of_movers), len(kinds) - 1], np.int16)
    kind = number[np.maximum(truth.mover, -1)]
    return Known(truth.static, kind, truth.mover >= -1, kinds, met_at_rest(truth, offset))


def met_at_rest(truth: Truth, offset: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(M,) whether what a beam met was at rest from the first scan to the last that met it.

    What is not there at all at some time, as what is brought or taken away, does not count.
    """
    scan = np.repeat(np.arange(len(offset) - 1), np.diff(offset))
    rested = np.zeros(len(of_movers := truth.scene["mover_kinds"]) + 1, np.bool_)
    for m in range(len(of_movers)):
        met, course = scan[truth.mover == m], truth.movers[:, m]
        if len(met) and np.isfinite(course).all():
            way = course[met[0] : met[-1] + 1] - course[met[0]]
            turned = np.abs(np.angle(np.exp(1j * way[:, 2])))
            gone = np.linalg.norm(way[:, :2], axis=1)
            rested[m] = gone.max() < _STOOD and turned.max() < _FACED
    return rested[np.maximum(truth.mover, -1)]


def labelled(folder: Path) -> Known:
    """The truth that files of labels state, one for each point."""
    labels = np.concatenate([np.fromfile(f, np.uint32) for f in sorted(folder.glob("*.label"))])
    meaning = labels & 0xFFFF  # the upper half numbers instances
    moves, static = meaning == _MOVING, meaning == _STATIC
    kind = np.where(moves, 0, 1).astype(np.int16)
    return Known(static, kind, moves | static, ["moving", NOBODY], np.zeros(len(kind), np.bool_))


def lidar_poses(path: Path) -> Float:
    """(T, 4, 4) T_map_lidar of a file with twelve numbers a line."""
    rows = np.loadtxt(path, ndmin=2).reshape(-1, 3, 4)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows
    return poses


def write_given(
    work: Path, recording: stillmap.Recording, poses: Float
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Points for those that take points alone; which beams (K,) these are, and which are near.

    All beams that hit something at least NEAREST away, without the motion during the sweep. Nearer
    ones nobody is given: points at the sensor itself spoil all labels of DUFOMap. Those beyond
    FARTHEST help it, as they show free space.
    """
    seen = slam.deskew_recording(recording, poses, stillmap.Options().slam)
    beams: list[NDArray[np.int64]] = []
    near: list[NDArray[np.bool_]] = []
    with (work / "points.bin").open("wb") as file:
        for t in range(recording.n_scans):
            part = seen.beams_of(t)
            points = np.asarray(seen.points[part])
            far = np.linalg.norm(points.astype(float), axis=1)
            kept = seen.hit[part] & (far >= NEAREST)
            points[kept].tofile(file)
            beams.append(part.start + np.flatnonzero(kept))
            near.append(far[kept] < FARTHEST)
    counts = [len(one) for one in beams]
    np.save(work / "offset.npy", np.concatenate([[0], np.cumsum(counts)]))
    np.save(work / "T_map_sensor.npy", recording.T_map_sensor(poses))
    return np.concatenate(beams), np.concatenate(near)


def known_of_given(work: Path) -> Known:
    """The truth (K,) of the beams that all were given."""
    kinds = json.loads((work / "case.json").read_text())["kinds"]
    static, kind, scored, rested = (
        np.load(work / f"{name}.npy") for name in ("static", "kind", "scored", "rested")
    )
    return Known(static, kind, scored, kinds, rested)
