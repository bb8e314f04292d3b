"""Things are larger than a voxel: what is beside an element tells of it. See `docs/space.md`."""

from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.em.chunks import chunks
from stillmap.em.looks import look_numbers
from stillmap.em.options import DwellOptions
from stillmap.recording.model import Recording


class BesideOptions(TypedDict):
    """How elements are asked about each other, see `settled`."""

    radius: float
    coplanar: float
    for_static: float
    for_dynamic: float
    least: float
    most: float
    moved: float
    rounds: int


BESIDE: BesideOptions = {
    "radius": 2.5,  # cells
    "coplanar": 0.2,  # cells
    "for_static": 5.0,  # nats, all of these
    "for_dynamic": 10.0,
    "least": -4.0,
    "most": 3.0,  # what was hit for ten seconds in a row is a wall, or has stopped
    "moved": 0.1,
    "rounds": 10,
}
_NEVER = (np.iinfo(np.int32).max, -1)
_CERTAIN = 1e-6


def with_those_beside(
    p_static: NDArray[np.float32],
    surface: _core.Surface3D,
    recording: Recording,
    T_map_sensor: NDArray[np.float64],
    options: DwellOptions,
    threads: int,
) -> NDArray[np.float32]:
    """(E,) P(static) by what was seen of each element (E,) and by the elements beside it."""
    spans = np.empty((surface.size, 2), np.int32)
    spans[:] = _NEVER
    look = look_numbers(recording, options.look)
    for scans, beams, offset in chunks(recording):
        points, hit = recording.points[beams], recording.hit[beams]
        _core.widen_spans(surface, points, hit, offset, T_map_sensor[scans], look[scans], spans)
    p = np.clip(p_static, _CERTAIN, 1.0 - _CERTAIN)
    log_odds = np.log(p / (1.0 - p)).astype(np.float32)
    return _core.settled(surface, log_odds, spans, **BESIDE, threads=threads)
