"""Surfel maps of the kernels and of the plain reference, of the same beams."""

import numpy as np
import reference

from stillmap import _core


def fit_both(kind, resolution, *beams):
    """The `kind` of surfel map (of the kernel, plain), fitted to beams and time bins."""
    made = []
    for kernels in (_core, reference):
        surface = getattr(kernels, kind)(resolution)
        surface.add_end_points(*beams)
        surface.fit()
        made.append(surface)
    return made


def order(surface):
    """Indices of the surfels by their cells: the two number them differently."""
    return np.lexsort(surface.surfels()[0].T)
