"""Simulations as folders: recordings and, beside them, the truth."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import write_npy, write_npz
from stillmap.core.camera import Images
from stillmap.core.errors import InputError
from stillmap.core.files import atomic_folder
from stillmap.io import stillmap_folder
from stillmap.io.carmen import writer
from stillmap.io.images import write_png
from stillmap.io.registry import RIG_FOLDERS
from stillmap.io.trajectory import write_tum
from stillmap.sim import truth
from stillmap.sim.camera import CameraSimulator
from stillmap.sim.scene import Scene
from stillmap.sim.sessions import (
    SESSIONS_FILE,
    SessionPlan,
    compute_overlap,
    list_changes,
    observe,
    simulate_sessions,
)
from stillmap.sim.simulator import RigSimulation, Simulation
from stillmap.sim.truth import ImageTruth, Truth, image_files

Format = Literal["stillmap", "carmen"]

CARMEN_LOG = "recording.log"
MARK = "truth"  # every simulation has it
RIG_MARK = "tilting/truth"  # every one of two lasers has it
SESSIONS_MARK = "session-1/truth"  # every folder of simulated sessions has it, no place does
_MAX_DISTANCE = 65.535  # m, of a 16-bit image in millimetres


def write_simulation(
    simulation: Simulation,
    path: str | Path,
    *,
    format: Format = "stillmap",
    overwrite: bool = False,
) -> None:
    """Write recording and truth into one folder that appears complete or not at all.

    Args:
        simulation: what `simulate` returned.
        path: the folder.
        format: "stillmap" writes the files of a recording folder, "carmen" a `recording.log`
            with FLASER, RLASER and ODOM lines, ranges in whole centimetres.
        overwrite: replace an earlier simulation.

    Raises:
        InputError: the folder holds something already or cannot be written to, or the format
            cannot say what the laser measures.
    """
    if format == "carmen":
        require_carmen(simulation.scene)
    with atomic_folder(Path(path), MARK, overwrite) as work:
        if format == "carmen":
            _write_carmen(simulation, work / CARMEN_LOG)
            _write_truth(simulation.truth, simulation.recording.stamp_ns, work)
        else:
            _write_folder(simulation, work)


def write_rig(rig: RigSimulation, path: str | Path, *, overwrite: bool = False) -> None:
    """Write what two lasers recorded, each with its truth, into one folder.

    `horizontal` and `tilting` are folders as `write_simulation` makes them; `joint_angle.npy` (T,)
    beside them has the joint's angle in rad at each stamp.

    Raises:
        InputError: the folder holds something already or cannot be written to.
    """
    with atomic_folder(Path(path), RIG_MARK, overwrite) as work:
        for name, simulation in zip(RIG_FOLDERS, (rig.horizontal, rig.tilting), strict=True):
            (work / name).mkdir()
            _write_folder(simulation, work / name)
        write_npy(work / "joint_angle.npy", rig.joint_angle)


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
    sights, counts = [], []
    with atomic_folder(Path(path), SESSIONS_MARK, overwrite) as work:
        for place, plan in enumerate(plans):
            for simulation in simulate_sessions(plan):
                name = f"session-{len(about) + 1}"
                (work / name).mkdir()
                _write_folder(simulation, work / name)
                about.append({"name": name, "place": place, **_describe(simulation)})
                sights.append(observe(simulation))
                counts.append({"name": name, **count_beams(simulation)})
                if tell is not None:
                    tell(len(about) / total)
        names, places = ([session[key] for session in about] for key in ("name", "place"))
        objects, scene = plans[0].objects if len(plans) == 1 else (), plans[0].scenes[0]
        changes = list_changes(objects, scene.heights if scene.in_3d else None)
        tree = {
            "format_version": 1,
            "scene": [plan.name for plan in plans],
            "seed": seed,
            "sessions": about,
            "objects": [item.to_dict(number) for number, item in enumerate(objects)],
            "changes": [change.to_dict(number, names) for number, change in enumerate(changes)],
            "overlap": np.round(compute_overlap(sights, places), 4).tolist(),
        }
        text = json.dumps(tree, indent=1) + "\n"
        (work / SESSIONS_FILE).write_text(text, encoding="utf-8")
    return counts


def _describe(simulation: Simulation) -> dict[str, Any]:
    scene, recording = simulation.scene, simulation.recording
    sensor = scene.lidar if scene.in_3d else scene.laser
    return {
        "T_world_session": simulation.truth.T_world_base[0].tolist(),
        "first_stamp_ns": int(recording.stamp_ns[0]),
        "scans": recording.n_scans,
        "beams_per_scan": scene.lidar.columns if scene.in_3d else scene.laser.beams,
        "fov": 2 * np.pi if scene.in_3d else scene.laser.fov,
        "mount": [sensor.x, sensor.y, sensor.yaw],
    }


def count_beams(simulation: Simulation) -> dict[str, int]:
    """Numbers of scans, beams, hits, and hits on movers."""
    return {
        "scans": simulation.recording.n_scans,
        "beams": simulation.recording.n_beams,
        "hits": int(np.count_nonzero(simulation.recording.hit)),
        "dynamic": int(np.count_nonzero(simulation.truth.mover >= 0)),
    }


def _write_folder(simulation: Simulation, work: Path) -> None:
    """A recording folder with its truth, and pictures with theirs, into an existing folder."""
    recording = simulation.recording
    _write_truth(simulation.truth, recording.stamp_ns, work)
    if simulation.photographs is not None and simulation.surfaces is not None:
        _write_image_truth(simulation.surfaces, work / truth.FOLDER)
        images = _write_truth_on_read(simulation.photographs, work / truth.FOLDER)
        recording = replace(recording, images=images)
    stillmap_folder.write_into(recording, work)


def _write_truth(of_beams: Truth, stamp_ns: NDArray[np.int64], folder: Path) -> None:
    inside = folder / truth.FOLDER
    inside.mkdir()
    for name in (*truth.ARRAYS, *truth.OPTIONAL):
        array = getattr(of_beams, name)
        if array is not None and (name in truth.ARRAYS or len(array)):
            write_npy(inside / f"{name}.npy", np.asarray(array))
    write_tum(inside / "trajectory.tum", stamp_ns, of_beams.T_world_base)
    scene = json.dumps(of_beams.scene, indent=1) + "\n"
    (inside / truth.SCENE).write_text(scene, encoding="utf-8")


def _write_image_truth(surfaces: ImageTruth, folder: Path) -> None:
    """All but masks and distances."""
    faces, solids, ground, ceiling = surfaces.standing
    standing: dict[str, NDArray[Any]] = {
        "faces_ends": faces.ends,
        "faces_z": faces.z,
        "faces_glass": faces.is_glass,
        **{f"solids_{name}": value for name, value in solids._asdict().items()},
        **{f"ground_{name}": np.asarray(value) for name, value in ground._asdict().items()},
        "ceiling": np.array(np.nan if ceiling is None else ceiling),
        "colour_seed": np.array(surfaces.colour_seed),
    }
    write_npz(folder / truth.STANDING, standing)
    moving = surfaces.moving.solids._asdict()
    write_npy(folder / truth.POSE, moving.pop("pose"))
    write_npz(folder / truth.MOVING, {"stamp_ns": surfaces.moving.stamp_ns, **moving})
    write_npy(folder / truth.CAMERAS, surfaces.T_world_camera)


def _write_truth_on_read(photographs: CameraSimulator, folder: Path) -> Images:
    """The images; reading one writes its truth, so that each is rendered once only."""
    (folder / truth.IMAGES).mkdir()

    def load(image: int) -> NDArray[np.uint8]:
        seen = photographs.render(image)
        mask, distance = image_files(folder, image)
        write_png(seen.mask, mask)
        near = np.where(seen.distance < _MAX_DISTANCE, seen.distance, 0.0)
        write_png(np.rint(1e3 * near).astype(np.uint16), distance)
        return seen.color

    images = photographs.images
    return Images(images.stamp_ns, images.camera, images.cameras, load)


def require_carmen(scene: Scene) -> None:
    """Refuse scans for FLASER lines, which hold half a circle and ranges below the SICK's code.

    Raises:
        InputError: they cannot.
    """
    if scene.in_3d:
        raise InputError("CARMEN logs hold no 3D scans", hint="the recording folder")
    laser = scene.laser
    if abs(laser.fov - math.pi) > 1e-9:
        raise InputError("FLASER lines hold half a circle", hint="a field of view of 180 degrees")
    if laser.upside_down == "known":
        what = "FLASER lines cannot say that the laser hangs upside down"
        raise InputError(what, hint="laser.upside_down=unknown")
    if laser.max_range > writer.NO_RETURN:
        what = f"CARMEN logs hold ranges up to {writer.NO_RETURN} m"
        raise InputError(what, hint="a lower max_range")


def _write_carmen(simulation: Simulation, path: Path) -> None:
    form = writer.LogFormat(
        lasers=(writer.LaserFormat("FLASER"), writer.LaserFormat("RLASER")),
        scan_angles=None,
        params={},
        comment=f"stillmap simulate {simulation.scene.name}",
        host="simulated",
        digits=2,
    )
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.writelines(writer.format_lines(simulation.recording, form))
