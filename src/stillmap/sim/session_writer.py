"""Simulated sessions as a folder: a recording with truth for each, and what they have in common."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core.files import atomic_folder
from stillmap.sim.session_overlap import Sight, compute_overlap, observe
from stillmap.sim.session_truth import FILE, MARK, describe_object, list_changes
from stillmap.sim.sessions import SessionPlan, simulate_sessions
from stillmap.sim.simulator import Simulation
from stillmap.sim.writer import write_folder


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
    with atomic_folder(Path(path), MARK, overwrite) as work:
        for place, plan in enumerate(plans):
            for one in simulate_sessions(plan):
                name = f"session-{len(about) + 1}"
                (work / name).mkdir()
                write_folder(one, work / name)
                about.append({"name": name, "place": place, **_describe(one)})
                sights.append(observe(one))
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
