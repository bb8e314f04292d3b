"""Invalid arguments raise errors that name the argument."""

import numpy as np
import pytest

from stillmap import _core

KERNELS = ["add_beams", "e_step", "log_likelihood"]


def arguments(kernel, dimension=2):
    """Valid arguments: 5 beams in 2 scans."""
    out = {
        "grid": (_core.OccupancyGrid2D if dimension == 2 else _core.OccupancyGrid3D)(0.5),
        "points": np.ones((5, dimension), np.float32),
        "hit": np.ones(5, bool),
        "e": np.full(5, 0.5, np.float32),
        "offset": np.array([0, 2, 5]),
        "T_map_sensor": np.tile(np.eye(dimension + 1), (2, 1, 1)),
        "prior": 0.5,
    }
    if kernel == "e_step":
        del out["e"]
    if kernel == "add_beams":
        del out["prior"]
    return out


def assert_raises(kernel, error, match, dimension=2, **changes):
    good = arguments(kernel, dimension)
    getattr(_core, kernel)(**good)
    if not set(changes) <= set(good):
        return
    for threads in (1, 2):
        with pytest.raises(error, match=match):
            getattr(_core, kernel)(**{**good, **changes}, threads=threads)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("hit", np.ones(4, bool)),
        ("hit", np.ones(6, bool)),
        ("e", np.ones(4, np.float32)),
        ("e", np.ones(6, np.float32)),
        ("offset", np.array([0, 5])),
        ("offset", np.array([0, 2, 3, 5])),
        ("offset", np.array([], np.int64)),
        ("offset", np.array([1, 2, 5])),
        ("offset", np.array([0, 2, 4])),
        ("offset", np.array([0, 2, 6])),
        ("offset", np.array([0, 6, 5])),
        ("offset", np.array([0, -1, 5])),
        ("prior", -0.01),
        ("prior", 1.01),
        ("prior", float("nan")),
    ],
)
def test_wrong_lengths_and_values(kernel, dimension, name, value):
    assert_raises(kernel, ValueError, name, dimension, **{name: value})


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("points", np.ones((5, 2))),
        ("points", np.ones((5, 3), np.float32)),
        ("points", np.ones(10, np.float32)),
        ("points", np.ones((2, 5), np.float32).T),
        ("hit", np.ones(5, np.uint8)),
        ("hit", np.ones((5, 1), bool)),
        ("e", np.ones(5)),
        ("offset", np.array([0, 2, 5], np.int32)),
        ("offset", np.array([0.0, 2, 5])),
        ("T_map_sensor", np.tile(np.eye(4), (2, 1, 1))),
        ("T_map_sensor", np.tile(np.eye(3, dtype=np.float32), (2, 1, 1))),
        ("T_map_sensor", np.eye(3)),
        ("grid", _core.OccupancyGrid3D(0.5)),
        ("prior", "half"),
    ],
)
def test_wrong_types_and_shapes(kernel, name, value):
    assert_raises(kernel, TypeError, name, **{name: value})


@pytest.mark.parametrize("bad", [-0.01, 1.01, np.nan, np.inf])
def test_expectations_of_hits_are_probabilities(bad):
    e = np.full(5, 0.5, np.float32)
    e[3] = bad
    assert_raises("add_beams", ValueError, "e: ", e=e)
    good = arguments("add_beams")
    good["hit"][3] = False  # e of a maximum-range beam is not used
    _core.add_beams(**{**good, "e": e})


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e30])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.usefixtures("bounded_memory")
def test_poses_that_are_not_finite_or_far_away(kernel, bad, dimension):
    for row in range(dimension):
        for column in range(dimension + 1):
            T = np.tile(np.eye(dimension + 1), (2, 1, 1))
            T[1, row, column] = bad
            assert_raises(kernel, ValueError, "pose", dimension, T_map_sensor=T)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.usefixtures("bounded_memory")
def test_end_points_far_away(kernel):
    points = np.ones((5, 2), np.float32)
    points[4, 1] = 1e30
    assert_raises(kernel, ValueError, "end point", points=points)
