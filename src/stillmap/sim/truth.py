"""The truth of a simulation: read by the scores, never by the mapping."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import open_npy, write_npy
from stillmap.core.errors import InputError
from stillmap.io.trajectory import write_tum

FOLDER = "truth"
_SCENE = "scene.json"
_ARRAYS = ("static", "mover", "T_world_base", "walls", "movers")
_PER_BEAM = ("static", "mover")
_LASTING = "lasting"  # only where there are any


@dataclass(frozen=True, eq=False)
class Truth:
    """The truth about T scans with M beams in all, among P movers and W walls.

    Attributes:
        static: (M,) bool, whether a static surface reflected the beam.
        mover: (M,) int32, id of the mover that reflected the beam; -1: none, -2: the robot itself.
        T_world_base: (T, D+1, D+1) float64 true poses.
        walls: (W, 4) float64 segments x0, y0, x1, y1 in metres.
        movers: (T, P, 3) float64, pose of each mover at each scan: x, y of its center in metres,
            heading in rad. First people, then doors (heading: from the hinge), then vehicles, then
            movable objects; NaN while absent.
        scene: name, seed and all parameters as JSON; `mover_kinds`: kind of each mover ("person",
            "door", "car", "forklift" or "thing"); with a lidar `mover_sizes`: length, width and
            height of each in metres, null where undefined.
        lasting: (K, 4) faces of moved or added objects, at the end.
    """

    static: NDArray[np.bool_]
    mover: NDArray[np.int32]
    T_world_base: NDArray[np.float64]
    walls: NDArray[np.float64]
    movers: NDArray[np.float64]
    scene: dict[str, Any]
    lasting: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 4)))


def write_truth(truth: Truth, stamp_ns: NDArray[np.int64], folder: Path) -> None:
    """Write the `truth` folder into an existing folder."""
    inside = folder / FOLDER
    inside.mkdir()
    for name in (*_ARRAYS, *([_LASTING] if len(truth.lasting) else [])):
        # per-beam arrays may be larger than memory
        write = write_npy if name in _PER_BEAM else np.save
        write(inside / f"{name}.npy", getattr(truth, name))
    write_tum(inside / "trajectory.tum", stamp_ns, truth.T_world_base)
    (inside / _SCENE).write_text(json.dumps(truth.scene, indent=1) + "\n", encoding="utf-8")


def load_truth(path: str | Path) -> Truth:
    """Load the truth of a simulation, given its folder or the `truth` folder inside.

    Raises:
        InputError: there is none, or it is damaged.
    """
    folder = Path(path)
    if (folder / FOLDER).is_dir():
        folder = folder / FOLDER
    if not (folder / _SCENE).is_file():
        raise InputError(
            "holds no truth", where=str(path), hint="a folder that 'stillmap simulate' wrote"
        )
    try:
        arrays = {
            name: np.array(open_npy(folder / f"{name}.npy"))
            for name in (*_ARRAYS, *([_LASTING] if (folder / f"{_LASTING}.npy").exists() else []))
        }
        return Truth(**arrays, scene=json.loads((folder / _SCENE).read_text(encoding="utf-8")))
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"is damaged: {error}", where=str(folder)) from error
