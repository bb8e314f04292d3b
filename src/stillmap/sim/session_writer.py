"""Simulated sessions as a folder: a recording with truth for each, and what they have in common."""

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.files import atomic_folder
from stillmap.sim.planner import Float
from stillmap.sim.session_truth import FILE, describe_object, list_changes
from stillmap.sim.sessions import SessionPlan, simulate_sessions
from stillmap.sim.simulator import Simulation
from stillmap.sim.writer import write_folder

_CELL, _CELL_3D = 0.1, 0.5  # m, of the area that counts as observed
_EVERY = 3  # of the scans, for that area
_BLOCK = 200  # scans at once


class Sight(NamedTuple):
    """What one session saw: cells (K, 2) that it observed, and of each static hit (H, 2)."""

    observed: NDArray[np.int64]
    hits: NDArray[np.int64]


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
    sights: list[Sight] = []
    counts: list[dict[str, Any]] = []
    with atomic_folder(Path(path), FILE, overwrite) as work:
        for place, plan in enumerate(plans):
            for one in simulate_sessions(plan):
                name = f"session-{len(about) + 1}"
                (work / name).mkdir()
                write_folder(one, work / name)
                about.append({"name": name, "place": place, **_describe(one)})
                sights.append(_look(one))
                counts.append({"name": name, **_count(one)})
                if tell is not None:
                    tell(len(about) / total)
        tree = {**_describe_plans(plans, seed, [one["name"] for one in about], about)}
        places = [one["place"] for one in about]
        tree["overlap"] = np.round(compute_overlap(sights, places), 4).tolist()
        (work / FILE).write_text(json.dumps(tree, indent=1) + "\n", encoding="utf-8")
    return counts


def _describe_plans(
    plans: Sequence[SessionPlan], seed: int, names: list[str], about: list[dict[str, Any]]
) -> dict[str, Any]:
    objects = plans[0].objects if len(plans) == 1 else ()
    scene = plans[0].scenes[0]
    changes = list_changes(objects, scene.heights if scene.in_3d else None)
    return {
        "format_version": 1,
        "scene": [plan.name for plan in plans],
        "seed": seed,
        "sessions": about,
        "objects": [describe_object(number, one) for number, one in enumerate(objects)],
        "changes": [change.to_dict(k, names) for k, change in enumerate(changes)],
    }


def _describe(one: Simulation) -> dict[str, Any]:
    scene, recording = one.scene, one.recording
    sensor = scene.lidar if scene.in_3d else scene.laser
    return {
        "T_world_session": one.truth.T_world_base[0].tolist(),
        "first_stamp_ns": int(recording.stamp_ns[0]),
        "scans": recording.n_scans,
        "beams_per_scan": scene.lidar.columns if scene.in_3d else scene.laser.beams,
        "fov": 2 * np.pi if scene.in_3d else scene.laser.fov,
        "mount": [sensor.x, sensor.y, sensor.yaw],
    }


def _count(one: Simulation) -> dict[str, int]:
    return {
        "scans": one.recording.n_scans,
        "beams": one.recording.n_beams,
        "hits": int(np.count_nonzero(one.recording.hit)),
        "dynamic": int(np.count_nonzero(one.truth.mover >= 0)),
    }


def _look(one: Simulation) -> Sight:
    """The cells that a session observed: passed or hit in 2D, hit in 3D."""
    cell = _CELL_3D if one.scene.in_3d else _CELL
    hits, seen = [], [np.empty((0, 2), np.int64)]
    for scans, start, end, static in _beams_in_world(one):
        hits.append(np.floor(end[static] / cell).astype(np.int64))
        if one.scene.in_3d:
            seen.append(np.unique(hits[-1], axis=0))
        else:
            some = scans % _EVERY == 0
            seen.append(_passed_cells(start[some], end[some], cell))
    return Sight(np.unique(np.concatenate(seen), axis=0), np.concatenate(hits))


def _beams_in_world(
    one: Simulation,
) -> Iterator[tuple[NDArray[np.int64], Float, Float, NDArray[np.bool_]]]:
    """Scan, start and end in the plane, and whether a static surface was hit, of M beams."""
    recording, truth = one.recording, one.truth
    T_world_sensor = truth.T_world_base @ recording.T_base_sensor[recording.sensor]
    for first in range(0, recording.n_scans, _BLOCK):
        last = min(first + _BLOCK, recording.n_scans)
        part = slice(int(recording.offset[first]), int(recording.offset[last]))
        counts = np.diff(recording.offset[first : last + 1])
        scans = np.repeat(np.arange(first, last), counts)
        T = T_world_sensor[scans]
        points = np.asarray(recording.points[part], np.float64)
        end = np.einsum("nij,nj->ni", T[:, :2, :-1], points) + T[:, :2, -1]
        yield scans, T[:, :2, -1], end, np.asarray(truth.static[part])


def _passed_cells(start: Float, end: Float, cell: float) -> NDArray[np.int64]:
    """(K, 2) cells within half a cell of points along beams from (N, 2) to (N, 2)."""
    steps = np.ceil(np.hypot(*(end - start).T) / cell).astype(np.int64)
    found = [np.empty((0, 2), np.int64)]
    for n in range(int(steps.max(initial=0)) + 1):
        longer = steps >= n
        share = n / np.maximum(steps[longer], 1)
        at = start[longer] + share[:, None] * (end - start)[longer]
        found.append(np.unique(np.floor(at / cell).astype(np.int64), axis=0))
    return np.unique(np.concatenate(found), axis=0)


def compute_overlap(sights: Sequence[Sight], places: Sequence[int]) -> Float:
    """(S, S) share of the static hits of session j in cells that session i observed.

    Sessions of different places have none in common.
    """
    every = np.concatenate([cells for sight in sights for cells in sight])
    low = every.min(axis=0)
    shape = every.max(axis=0) - low + 1
    overlap = np.zeros((len(sights), len(sights)))
    for i, one in enumerate(sights):
        seen = np.zeros(shape, bool)
        seen[tuple((one.observed - low).T)] = True
        for j, other in enumerate(sights):
            if places[i] == places[j] and len(other.hits):
                overlap[i, j] = seen[tuple((other.hits - low).T)].mean()
    return overlap
