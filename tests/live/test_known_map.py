"""Known maps: damage is named in one line; voxels that stand or are gone, by those around them."""

import numpy as np
import pytest

from stillmap.core.errors import InputError
from stillmap.live.known_cloud import KnownCloud, _share_evidence
from stillmap.live.known_map import KnownMap

VERTEX = np.dtype([(name, "<f4") for name in ("x", "y", "z", "p_static")])


@pytest.fixture
def place(tmp_path):
    """A room of 8 m, and the points of its walls."""
    p_occupied = np.full((40, 40), 0.01, np.float32)
    p_occupied[[0, -1]] = p_occupied[:, [0, -1]] = 0.99
    put_map(tmp_path, p_occupied=p_occupied, alpha=10.0 * p_occupied)
    rows, columns = np.nonzero(p_occupied > 0.5)
    points = np.zeros(3 * len(rows), VERTEX)
    points["x"], points["y"] = np.tile([0.2 * columns + 0.1, 0.2 * rows + 0.1], 3)
    points["z"], points["p_static"] = np.repeat([0.1, 0.6, 1.1], len(rows)), 0.9
    put_points(tmp_path, points)
    (tmp_path / "trajectory.tum").write_text("0 4 4 0.5 0 0 0 1\n1 4.5 4 0.5 0 0 0 1\n")
    (tmp_path / "live").mkdir()
    return tmp_path


def put_map(folder, **layers):
    path = folder / "map.npz"
    known = {"origin": np.zeros(3), "resolution": 0.2}
    if path.exists():
        with np.load(path) as file:
            known = dict(file)
    np.savez(path, **{**known, **layers})


def put_points(folder, points):
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    head += [f"property float {name}" for name in VERTEX.names]
    text = "\n".join([*head, "end_header\n"])
    (folder / "static.ply").write_bytes(text.encode() + points.tobytes())


def open_cloud(folder):
    known = KnownCloud(folder, KnownMap(folder))
    known.make_local_map()
    known.find_voxels(0.2, (0.1, 2.0))
    return known.keep(None, 1.0, 0.2, (0.1, 2.0))


def test_it_is_a_known_map(place):
    np.save(place / "live/known_route.npy", np.eye(4)[None])
    kept = open_cloud(place)
    assert kept.route.shape == (3, 4, 4)
    p_occupied = KnownMap(place).grid.p_occupied
    put_map(place, p_occupied=p_occupied.astype(np.longdouble))
    np.testing.assert_array_equal(KnownMap(place).grid.p_occupied, p_occupied)
    assert kept.stands.any()


@pytest.mark.parametrize(
    ("name", "layer"),
    [
        ("alpha", np.full((40, 40), np.inf)),
        ("alpha", np.full((40, 40), "x")),
        ("alpha", np.ones((40, 39))),
        ("p_occupied", np.full((40, 40), -0.5)),
        ("p_occupied", np.full((40, 40), 1.0 + 1j)),
    ],
)
def test_layers_of_the_map(place, name, layer):
    put_map(place, **{name: layer})
    with pytest.raises(InputError, match=rf"map\.npz: {name} is"):
        KnownMap(place).make_grid()


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("x", 1e30, "not finite, or too far away"),
        ("z", 1e8, "more than 50 km"),
        ("p_static", 1e30, "p_static is no probability"),
    ],
)
def test_points(place, field, value, said):
    body = (place / "static.ply").read_bytes().partition(b"end_header\n")[2]
    points = np.frombuffer(body, VERTEX).copy()
    points[field][3] = value
    put_points(place, points)
    with pytest.raises(InputError, match=rf"static\.ply: .*{said}"):
        open_cloud(place)


@pytest.mark.parametrize(
    "route",
    [
        np.eye(4),
        np.array([None]),
        np.ones((2, 4, 4)),
        np.full((2, 4, 4), np.nan),
        np.eye(4)[None] + np.array([0.0, 0.0, 0.0, 1e12]),
    ],
)
def test_poses_from_where_it_was_made(place, route):
    np.save(place / "live/known_route.npy", route)
    with pytest.raises(InputError, match=r"known_route\.npy"):
        open_cloud(place)


P_UNSEEN, P_MISSED, P_HIT = 0.967, 0.003, 0.9999


def wall_of(rows, columns, y):
    """(rows x columns, 3) voxels of a vertical wall."""
    return np.array([[x, y, z] for x in range(columns) for z in range(rows)])


def in_order(cells, p_occupied):
    order = np.lexsort(cells.T[::-1])
    return np.ascontiguousarray(cells[order]), p_occupied[order]


def test_what_no_ring_of_the_sweeps_met_goes_with_its_thing():
    cells = wall_of(8, 6, 0)
    is_seen = cells[:, 2] % 3 == 0
    cells, p_occupied = in_order(cells, np.where(is_seen, P_MISSED, P_UNSEEN))
    assert (p_occupied > 0.5).sum() == 30
    assert _share_evidence(cells, p_occupied, P_UNSEEN).max() < 0.5


def test_a_wall_behind_what_is_gone_stays_where_it_was_hit():
    box, wall = wall_of(8, 6, 0), wall_of(8, 20, 1)
    of_each = [
        np.where(part[:, 2] % 3 == 0, p, P_UNSEEN) for part, p in ((box, P_MISSED), (wall, P_HIT))
    ]
    cells, p_occupied = in_order(np.concatenate([box, wall]), np.concatenate(of_each))
    stands = _share_evidence(cells, p_occupied, P_UNSEEN) > 0.5
    is_wall = cells[:, 1] == 1
    assert stands[is_wall & (p_occupied == P_HIT)].all()
    assert stands[is_wall & (cells[:, 0] > 6)].all()
    assert not stands[~is_wall & (p_occupied == P_MISSED)].any()
