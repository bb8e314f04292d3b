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
def test_number_of_poses_against_scans(kernel):
    for poses in (0, 1, 3):
        T = np.tile(np.eye(3), (poses, 1, 1))
        assert_raises(kernel, ValueError, "T_map_sensor", T_map_sensor=T)


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


@pytest.mark.parametrize("make", [_core.OccupancyGrid2D, _core.OccupancyGrid3D])
@pytest.mark.parametrize("resolution", [0.0, -0.1, np.nan, np.inf])
def test_grid_resolution(make, resolution):
    with pytest.raises(ValueError, match="resolution"):
        make(resolution)


def test_merging_grids_that_differ():
    with pytest.raises(ValueError, match="resolution"):
        _core.OccupancyGrid2D(0.1).merge(_core.OccupancyGrid2D(0.2))
    with pytest.raises(TypeError, match="merge"):
        _core.OccupancyGrid2D(0.1).merge(_core.OccupancyGrid3D(0.1))


def test_cells_of_wrong_type():
    grid = _core.OccupancyGrid2D(0.1)
    for cells in (np.zeros((1, 3), np.int64), np.zeros((1, 2), np.int32), np.zeros(2, np.int64)):
        with pytest.raises(TypeError, match="cells"):
            grid.alpha_beta(cells)
    with pytest.raises(ValueError, match="cells"):
        grid.alpha_beta(np.array([[0, 2**40]]))


@pytest.mark.parametrize("kernel", ["registration_cost", "registration_gradient"])
@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("points", np.ones((5, 2)), TypeError),
        ("weights", np.ones(5), TypeError),
        ("weights", np.ones(4, np.float32), ValueError),
        ("weights", np.full(5, 2, np.float32), ValueError),
        ("T", np.eye(4), TypeError),
        ("T", np.full((3, 3), np.nan), ValueError),
        ("sigma", 0.0, ValueError),
        ("floor", 0.0, ValueError),
        ("unknown", -0.1, ValueError),
        ("radius", -1, ValueError),
        ("radius", 10**6, ValueError),
    ],
)
def test_registration(kernel, name, value, error):
    good = {
        "grid": _core.OccupancyGrid2D(0.5),
        "points": np.ones((5, 2), np.float32),
        "weights": np.ones(5, np.float32),
        "T": np.eye(3),
        "sigma": 0.1,
        "radius": 2,
        "floor": 0.01,
        "unknown": 0.1,
    }
    getattr(_core, kernel)(**good)
    with pytest.raises(error, match=name):
        getattr(_core, kernel)(**{**good, name: value})


def surfel_map_of(dimension=2, fitted=True):
    surface = (_core.SurfelMap2D if dimension == 2 else _core.SurfelMap3D)(0.5)
    good = arguments("add_beams", dimension)
    surface.add_end_points(*(good[k] for k in ("points", "hit", "offset", "T_map_sensor")))
    if fitted:
        surface.fit()
    return surface


def hmm_of(surface, **changes):
    chosen = {
        "rho": [0.9, 0.1],
        "tau": [1.0, 2.0],
        "p_detection": 0.9,
        "bin_seconds": 1.0,
        "lateral_std": 0.1,
        "margin": 0.2,
        "hit_radius": 0.3,
        "end_margin": 0.4,
    }
    kind = _core.OccupancyHmm2D if surface.dimension == 2 else _core.OccupancyHmm3D
    return kind(surface, **{**chosen, **changes})


WRONG_BEAMS = [
    ("points", np.ones((5, 2)), TypeError),
    ("points", np.ones((5, 4), np.float32), TypeError),
    ("hit", np.ones(4, bool), ValueError),
    ("hit", np.ones(5, np.uint8), TypeError),
    ("offset", np.array([0, 2, 6]), ValueError),
    ("offset", np.array([1, 2, 5]), ValueError),
    ("offset", np.array([0, 6, 5]), ValueError),
    ("offset", np.array([0, 2, 5], np.int32), TypeError),
    ("T_map_sensor", np.tile(np.eye(5), (2, 1, 1)), TypeError),
    ("T_map_sensor", np.tile(np.eye(3), (1, 1, 1)), ValueError),
]


@pytest.mark.parametrize("call", ["add_end_points", "associate_beams", "add"])
@pytest.mark.parametrize(("name", "value", "error"), WRONG_BEAMS)
def test_beams_of_surfel_maps_and_hmms(call, name, value, error):
    surface = surfel_map_of(fitted=call != "add_end_points")
    beams = arguments("add_beams")
    beams = {k: beams[k] for k in ("points", "hit", "offset", "T_map_sensor")}
    target = hmm_of(surface) if call == "add" else surface
    more = {"time_bin": np.arange(2)} if call == "add" else {}
    getattr(target, call)(**beams, **more)
    with pytest.raises(error, match=name):
        getattr(target, call)(**{**beams, name: value}, **more)


@pytest.mark.parametrize("dimension", [2, 3])
def test_positions_and_classes(dimension):
    hmm, scans = hmm_of(surfel_map_of(dimension)), arguments("add_beams", dimension)
    beams = {k: scans[k] for k in ("points", "hit", "offset", "T_map_sensor")}
    beams["time_bin"] = np.arange(2)
    for wrong in (np.zeros((3, dimension)), np.full((2, dimension), np.nan)):
        with pytest.raises(ValueError, match="positions"):
            hmm.add(**beams, positions=wrong)
    for wrong in (np.zeros((2, dimension), np.float32), np.zeros((2, dimension + 1))):
        with pytest.raises(TypeError, match="positions"):
            hmm.add(**beams, positions=wrong)
    hmm.add(**beams, positions=np.zeros((2, dimension)))
    for wrong in (np.ones(3, bool), np.zeros(2, bool)):
        with pytest.raises(ValueError, match="classes"):
            hmm.likelihood(wrong)
    with pytest.raises(TypeError):
        hmm.likelihood("all")


@pytest.mark.parametrize("call", ["add_end_points", "associate_beams", "add"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_poses_of_surfel_maps_and_hmms(call, dimension):
    surface = surfel_map_of(dimension, fitted=call != "add_end_points")
    beams = arguments("add_beams", dimension)
    beams = {k: beams[k] for k in ("points", "hit", "offset", "T_map_sensor")}
    target = hmm_of(surface) if call == "add" else surface
    more = {"time_bin": np.arange(2)} if call == "add" else {}
    for bad in (np.nan, 1e30):
        T = beams["T_map_sensor"].copy()
        T[1, 0, -1] = bad
        with pytest.raises(ValueError, match="pose"):
            getattr(target, call)(**{**beams, "T_map_sensor": T}, **more)


@pytest.mark.parametrize("make", [_core.SurfelMap2D, _core.SurfelMap3D])
@pytest.mark.parametrize("resolution", [0.0, -0.1, np.nan, np.inf])
def test_surfel_map_resolution(make, resolution):
    with pytest.raises(ValueError, match="resolution"):
        make(resolution)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rho", [0.0, 0.5]),
        ("rho", [0.5, 1.0]),
        ("rho", [0.5, -0.1]),
        ("rho", [0.5, np.nan]),
        ("rho", [0.5]),
        ("rho", [0.5] * 3),
        ("rho", []),
        ("tau", [0.0, 1.0]),
        ("tau", [1.0, -1.0]),
        ("tau", [1.0, np.nan]),
        ("tau", [1.0]),
        ("p_detection", 0.0),
        ("p_detection", 1.0),
        ("p_detection", np.nan),
        *((n, v) for n in ("bin_seconds", "lateral_std", "margin", "hit_radius", "end_margin")
          for v in (0.0, -1.0, np.nan, np.inf)),
    ],
)  # fmt: skip
def test_hmm_parameters(dimension, name, value):
    surface = surfel_map_of(dimension)
    hmm_of(surface)
    with pytest.raises(ValueError, match=name):
        hmm_of(surface, **{name: value})


@pytest.mark.parametrize("dimension", [2, 3])
def test_decreasing_time_bins(dimension):
    hmm = hmm_of(surfel_map_of(dimension))
    good = arguments("add_beams", dimension)
    beams = [good[k] for k in ("points", "hit", "offset", "T_map_sensor")]
    hmm.add(*beams, np.array([3, 5]))
    before = hmm.likelihood()
    for bins in ([6, 5], [4, 6], [2**40, -(2**40)]):
        with pytest.raises(ValueError, match="time_bin"):
            hmm.add(*beams, np.array(bins))
    for a, b in zip(before, hmm.likelihood(), strict=True):
        assert a.tobytes() == b.tobytes()  # a failed call changes nothing
    for bins in (np.array([6]), np.array([6, 7, 8])):
        with pytest.raises(ValueError, match="time_bin"):
            hmm.add(*beams, bins)
    for bins in (np.array([6, 7], np.int32), np.array([[6, 7]]), np.array([6.0, 7.0])):
        with pytest.raises(TypeError, match="time_bin"):
            hmm.add(*beams, bins)


@pytest.mark.parametrize("dimension", [2, 3])
def test_hmm_of_an_unfitted_map(dimension):
    with pytest.raises(ValueError, match="fit"):
        hmm_of(surfel_map_of(dimension, fitted=False))


@pytest.mark.parametrize("dimension", [2, 3])
def test_surfels_of_an_unfitted_map(dimension):
    with pytest.raises(ValueError, match="fit"):
        surfel_map_of(dimension, fitted=False).surfels()


@pytest.mark.parametrize("dimension", [2, 3])
def test_add_end_points_after_fit(dimension):
    surface = surfel_map_of(dimension)
    before = surface.surfels()
    points = np.zeros((400, dimension), np.float32)
    points[:, 0] = np.linspace(-100, 100, 400)
    beams = points, np.ones(400, bool), np.array([0, 400]), np.eye(dimension + 1)[None]
    with pytest.raises(ValueError, match="surfel_map"):
        surface.add_end_points(*beams)
    surface.fit()
    for a, b in zip(before, surface.surfels(), strict=True):
        assert a.tobytes() == b.tobytes()
