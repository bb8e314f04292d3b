"""`tilting/`: 3D data of a rig's tilting laser, beside the result of its planar laser."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.json import count_skipped
from stillmap.io.trajectory import write_tum
from stillmap.mapping.beam_statistics import count_beams
from stillmap.results.labels import write_labels
from stillmap.results.objects import write_objects_of
from stillmap.results.points import write_clouds
from stillmap.rig.build import TiltingResult

FOLDER = "tilting"


def write_tilting(
    folder: Path, tilting: TiltingResult, colours: NDArray[np.uint8] | None = None
) -> None:
    """Write `static.ply`, `dynamic.ply` and `tilting/`: labels, poses and objects in 3D; with
    the colours (M, 3) of its beams' ends."""
    seen, poses, p_static = tilting.deskewed, tilting.poses, tilting.p_static
    write_clouds(folder, seen, poses, p_static, colours)
    inside = folder / FOLDER
    inside.mkdir()
    write_labels(inside / "beams", tilting.recording, p_static, colours)
    write_tum(inside / "trajectory.tum", tilting.recording.stamp_ns, poses)
    write_objects_of(inside / "objects", tilting.objects, seen, poses, p_static)


def tilting_record(tilting: TiltingResult) -> dict[str, Any]:
    """The `tilting` entry of `run.json`."""
    counts = count_beams(tilting.deskewed, tilting.p_static)
    return {
        "input": tilting.recording.source,
        "counts": {
            "scans": tilting.recording.n_scans,
            **{name: counts[name] for name in ("beams", "hits", "max_range", "unusable")},
            "left_out": tilting.unposed_beams,
            "skipped": count_skipped(tilting.recording.source),
        },
        "dynamic": counts["dynamic"],
        "boxes": tilting.boxes_hit,
        "objects": len(tilting.objects),
        "learned": tilting.learned,
    }
