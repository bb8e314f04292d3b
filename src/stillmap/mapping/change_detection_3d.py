"""Things that came to stay, or left, in space: so many cells that say the same are one."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.em import ChangedCells, ChangeOptions
from stillmap.mapping.change_detection import Change, detect_changes
from stillmap.mapping.dwell_time import measure_dwell_times

_STAYS = 12.0  # s: what stands for less waits, and what is away for less is hidden
_HIGH = 0.4  # m: what is lower is the ground, met in other lines from elsewhere
_LARGE = 0.7  # m2 of surface that a thing shows at least


def detect_changes_3d(
    changed: ChangedCells,
    recording: Recording,
    poses: NDArray[np.float64],
    resolution: float,
    look: float,
    options: ChangeOptions,
) -> list[Change]:
    """Cells near each other that changed at the same time, as far as they are things that stood.

    Of each the `cells` are those of a plan (K, 2), `size` has three lengths, and `z` is known.

    Args: see `changed_places`; poses are (T, 4, 4) T_map_base, `resolution` is the edge of a voxel.
    """
    first, last = recording.stamp_ns[[0, -1]].tolist()
    cells = _Cells.of(changed, _STAYS / look, 1e-9 * (last - first) / look)
    places = detect_changes(cells, recording, resolution, look, options)
    things = [
        one
        for one in places
        if one.size[2] >= _HIGH
        and len(one.cells) * resolution**2 >= _LARGE
        and 1e-9 * min(one.stamp_ns - first, last - one.before_ns) >= _STAYS
    ]
    seen = measure_dwell_times(things, recording, poses, resolution)
    return [
        replace(one, cells=np.unique(one.cells[:, :2], axis=0))
        for one, seconds in zip(things, seen, strict=True)
        if seconds >= _STAYS
    ]


@dataclass(frozen=True, eq=False)
class _Cells:
    """Cells all of which are asked for, and nothing that stands beside them: see `Courses`."""

    cells: NDArray[np.int64]
    p_changing: NDArray[np.float32]
    p_object: NDArray[np.float32]
    p_unchanged: NDArray[np.float32]
    n_changes: NDArray[np.int32]
    change_bins: NDArray[np.int32]

    @classmethod
    def of(cls, changed: ChangedCells, least: float, looks: float) -> "_Cells":
        """Those that were as before, and otherwise, for so many looks of all of them at least."""
        before, after = changed.change_bins[..., 0], changed.change_bins[..., 1]
        once = (after[:, 1] >= least) & (looks - before[:, 1] >= least)
        twice = before[:, 1] - after[:, 0] >= least
        kept = np.flatnonzero(np.where(changed.n_changes == 1, once, twice))
        return cls(
            cells=changed.cells[kept],
            p_changing=np.ones(len(kept), np.float32),
            p_object=changed.p_object[kept],
            p_unchanged=np.zeros(len(kept), np.float32),
            n_changes=changed.n_changes[kept],
            change_bins=changed.change_bins[kept],
        )
