"""Things are larger than a voxel: what is beside an element tells of it. See `docs/space.md`."""

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.em.looks import Surface
from stillmap.em.options import BesideOptions

_CERTAIN = 1e-6


def with_those_beside(
    p_static: NDArray[np.float32], surface: Surface, options: BesideOptions, threads: int = 1
) -> NDArray[np.float32]:
    """(E,) P(static) by the looks at each element alone (E,) and by the elements beside it.

    Args:
        p_static: (E,) by the looks alone.
        surface: the elements, in space; it knows the looks of its end points.
        options: see BesideOptions.
        threads: same result with any number.
    """
    if not options.enabled:
        return p_static
    if not isinstance(surface, _core.Surface3D):
        raise TypeError("surface: expected one in space")
    p = np.clip(p_static, _CERTAIN, 1.0 - _CERTAIN)
    log_odds = np.log(p / (1.0 - p)).astype(np.float32)
    return _core.settled(surface, log_odds, **arguments(options), threads=threads)


def arguments(options: BesideOptions) -> dict[str, Any]:
    """Those of the kernel."""
    return {name: value for name, value in asdict(options).items() if name != "enabled"}
