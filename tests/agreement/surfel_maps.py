"""What the tests share: surfel maps of kernel and twin, and the comparison over threads."""

import numpy as np
import reference

from stillmap import _core


def fit_surfels(kernels, kind, resolution, *beams):
    """The `kind` of surfel map of a kernel or twin, fitted to beams and time bins."""
    surface = getattr(kernels, kind)(resolution)
    surface.add_end_points(*beams)
    surface.fit()
    return surface


def fit_both(kind, resolution, *beams):
    """Those of the kernel and of the twin."""
    return [fit_surfels(kernels, kind, resolution, *beams) for kernels in (_core, reference)]


def together(points):
    """Beams of one scan from the origin: all of them hits."""
    points = np.asarray(points, np.float32)
    T = np.eye(points.shape[1] + 1)[None]
    return points, np.ones(len(points), bool), np.array([0, len(points)]), T


def assert_same_bits(call, *threads):
    """The arrays that `call(threads)` gives are the same with every number of threads."""
    once = [np.asarray(values).tobytes() for values in call(1)]
    for number in threads:
        assert [np.asarray(values).tobytes() for values in call(number)] == once


def order(surface):
    """Indices of the surfels by their cells: the two number them differently."""
    return np.lexsort(surface.surfels()[0].T)
