"""A simulation as a folder: the recording and, beside it, the truth."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import write_npy
from stillmap.core.camera import Images
from stillmap.core.errors import InputError
from stillmap.core.files import atomic_folder
from stillmap.io import stillmap_folder
from stillmap.io.carmen import writer
from stillmap.io.images import write_png
from stillmap.io.registry import RIG_FOLDERS
from stillmap.sim.camera import CameraSimulator
from stillmap.sim.scene import Scene
from stillmap.sim.simulator import RigSimulation, Simulation
from stillmap.sim.truth import FOLDER, IMAGES, image_files, write_image_truth, write_truth

Format = Literal["stillmap", "carmen"]

CARMEN_LOG = "recording.log"
MARK = "truth"  # every simulation has it
RIG_MARK = "tilting/truth"  # every one of two lasers has it
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
            write_truth(simulation.truth, simulation.recording.stamp_ns, work)
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
        for name, one in zip(RIG_FOLDERS, (rig.horizontal, rig.tilting), strict=True):
            (work / name).mkdir()
            write_folder(one, work / name)
        write_npy(work / "joint_angle.npy", rig.joint_angle)


def write_folder(one: Simulation, work: Path) -> None:
    """A recording folder with its truth, and pictures with theirs, into an existing folder."""
    recording = one.recording
    write_truth(one.truth, recording.stamp_ns, work)
    if one.photographs is not None and one.surfaces is not None:
        write_image_truth(one.surfaces, work / FOLDER)
        images = _write_truth_on_read(one.photographs, work / FOLDER)
        recording = replace(recording, images=images)
    stillmap_folder.write_into(recording, work)


def _write_truth_on_read(photographs: CameraSimulator, folder: Path) -> Images:
    """The images; reading one writes its truth, so that each is rendered once only."""
    (folder / IMAGES).mkdir()

    def load(image: int) -> NDArray[np.uint8]:
        one = photographs.render(image)
        mask, distance = image_files(folder, image)
        write_png(one.mask, mask)
        near = np.where(one.distance < _MAX_DISTANCE, one.distance, 0.0)
        write_png(np.rint(1e3 * near).astype(np.uint16), distance)
        return one.color

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
