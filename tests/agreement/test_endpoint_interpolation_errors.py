"""Invalid arguments of end-point interpolation."""

import numpy as np
import pytest
import reference

from stillmap import _core

FILL = {"max_gap": 1.5, "tolerance": 0.1, "max_gap_ratio": 3.0}


def gaps(dimension=2):
    """Valid arguments: 5 beams in 2 scans; the gaps of the second one are interpolated."""
    points = np.ones((5, dimension), np.float32)
    points[:, 0] = [1.0, 2.0, 1.0, 2.0, 3.0]
    return {
        "grid": (_core.OccupancyGrid2D if dimension == 2 else _core.OccupancyGrid3D)(0.5),
        "points": points,
        "hit": np.ones(5, bool),
        "e": np.full(5, 0.5, np.float32),
        "offset": np.array([0, 2, 5]),
        "T_map_sensor": np.tile(np.eye(dimension + 1), (2, 1, 1)),
        **FILL,
    }


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("points", np.ones((5, 2)), TypeError),
        ("points", np.ones((5, 4), np.float32), TypeError),
        ("hit", np.ones(4, bool), ValueError),
        ("hit", np.ones(5, np.uint8), TypeError),
        ("e", np.ones(4, np.float32), ValueError),
        ("e", np.ones(5), TypeError),
        ("e", np.ones((5, 1), np.float32), TypeError),
        ("offset", np.array([0, 2, 6]), ValueError),
        ("offset", np.array([1, 2, 5]), ValueError),
        ("offset", np.array([0, 6, 5]), ValueError),
        ("offset", np.array([0, 5]), ValueError),
        ("offset", np.array([0, 2, 5], np.int32), TypeError),
        ("T_map_sensor", np.tile(np.eye(5), (2, 1, 1)), TypeError),
        ("grid", None, TypeError),
        *((name, bad, ValueError) for name in FILL for bad in (-0.1, -np.inf, np.nan)),
        *((name, "wide", TypeError) for name in FILL),
    ],
)
@pytest.mark.parametrize("remove", [False, True])
def test_argument_errors(dimension, name, value, error, remove):
    good = gaps(dimension)
    _core.interpolate_end_points(**good, remove=remove)
    with pytest.raises(error, match=name):
        _core.interpolate_end_points(**{**good, name: value}, remove=remove)


@pytest.mark.parametrize("bad", [-0.01, 1.01, np.nan, np.inf])
@pytest.mark.parametrize("beam", [2, 3, 4])
def test_e_out_of_range(bad, beam):
    e = np.full(5, 0.5, np.float32)
    e[beam] = bad
    for kernels, grid in (
        (_core, _core.OccupancyGrid2D(0.5)),
        (reference, reference.OccupancyGrid2D(0.5)),
    ):
        with pytest.raises(ValueError, match="e: "):
            kernels.interpolate_end_points(**{**gaps(), "e": e, "grid": grid})
    e = np.full(5, 0.5, np.float32)
    e[:2] = bad  # e of two beams that are not a surface is not used
    _core.interpolate_end_points(**{**gaps(), "e": e})


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e30])
@pytest.mark.usefixtures("bounded_memory")
def test_end_points_not_finite_or_far_away(bad, dimension):
    for row in range(dimension):
        T = np.tile(np.eye(dimension + 1), (2, 1, 1))
        T[1, row, -1] = bad
        with pytest.raises(ValueError, match="pose"):
            _core.interpolate_end_points(**{**gaps(dimension), "T_map_sensor": T})
    far = gaps(dimension)
    far["points"][:, 0] *= np.float32(1e30)
    _core.interpolate_end_points(**far)  # too wide: no gap is filled
    with pytest.raises(ValueError, match="end point"):
        _core.interpolate_end_points(**{**far, "max_gap": np.inf})
    assert not far["grid"].dense()[1].any()
    lost = gaps(dimension)
    lost["points"][3, 0] = bad
    _core.interpolate_end_points(**lost)  # a beam without an end point is skipped
    assert not lost["grid"].dense()[1].any()


@pytest.mark.parametrize("name", list(FILL))
@pytest.mark.parametrize("bad", [-0.1, np.nan])
def test_twin_raises_the_same_errors(name, bad):
    grid = reference.OccupancyGrid2D(0.5)
    with pytest.raises(ValueError, match=name):
        reference.interpolate_end_points(**{**gaps(), "grid": grid, name: bad})
    with pytest.raises(ValueError, match="e: "):
        reference.interpolate_end_points(**{**gaps(), "grid": grid, "e": np.ones(4)})
