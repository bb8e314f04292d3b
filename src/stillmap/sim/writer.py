"""Simulations as folders: recordings and, beside them, the truth."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_folder import write_arrays
from stillmap.core.arrays import write_npy, write_npz
from stillmap.core.camera import Images
from stillmap.core.files import atomic_folder
from stillmap.core.json import write_json
from stillmap.io import stillmap_folder
from stillmap.io.cameras import write_png
from stillmap.io.carmen.writer import write_log
from stillmap.io.registry import RIG_FOLDERS
from stillmap.io.trajectory import write_tum
from stillmap.sim import truth
from stillmap.sim.camera import CameraSimulator
from stillmap.sim.simulator import RigSimulation, Simulation
from stillmap.sim.truth import ImageTruth, Truth, image_files

CARMEN_LOG = "recording.log"
MARK = "truth"  # every simulation has it
RIG_MARK = "tilting/truth"  # every one of two lasers has it
_MAX_DISTANCE = 65.535  # m, of a 16-bit image in millimetres


def write_simulation(
    simulation: Simulation,
    path: str | Path,
    *,
    format: Literal["stillmap", "carmen"] = "stillmap",
    overwrite: bool = False,
) -> None:
    """Write recording and truth into one folder that appears complete or not at all.

    Args:
        simulation: what `simulate` returned.
        path: the folder.
        format: "stillmap" writes the files of a recording folder, "carmen" a `recording.log`.
        overwrite: replace an earlier simulation.

    Raises:
        InputError: the folder holds something already or cannot be written to, or the format
            cannot say what the laser measures.
    """
    with atomic_folder(Path(path), MARK, overwrite) as work:
        if format == "carmen":
            write_log(simulation.recording, work / CARMEN_LOG)
            _write_truth(simulation.truth, simulation.recording.stamp_ns, work)
        else:
            write_folder(simulation, work)


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
            write_folder(simulation, work / name)
        write_npy(work / "joint_angle.npy", rig.joint_angle)


def count_beams(simulation: Simulation) -> dict[str, int]:
    """Numbers of scans, beams, hits, and hits on movers."""
    return {
        "scans": simulation.recording.n_scans,
        "beams": simulation.recording.n_beams,
        "hits": int(np.count_nonzero(simulation.recording.hit)),
        "dynamic": int(np.count_nonzero(simulation.truth.mover >= 0)),
    }


def write_folder(simulation: Simulation, work: Path) -> None:
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
    arrays = {name: getattr(of_beams, name) for name in (*truth.ARRAYS, *truth.OPTIONAL)}
    if not len(of_beams.lasting):
        del arrays["lasting"]
    write_arrays(inside, arrays)
    write_tum(inside / "trajectory.tum", stamp_ns, of_beams.T_world_base)
    write_json(inside / truth.SCENE, of_beams.scene)


def _write_image_truth(surfaces: ImageTruth, folder: Path) -> None:
    """All but masks and distances."""
    faces, solids, ground, ceiling = surfaces.standing
    standing = {
        f"{name}_{key}": np.asarray(value)
        for name, part in (("faces", faces), ("solids", solids), ("ground", ground))
        for key, value in part._asdict().items()
    }
    standing["ceiling"] = np.array(np.nan if ceiling is None else ceiling)
    standing["colour_seed"] = np.array(surfaces.colour_seed)
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
