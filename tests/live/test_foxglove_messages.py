"""Messages of Foxglove's schemas, read back from their bytes, and what is put together for them."""

import numpy as np
import pytest

foxglove = pytest.importorskip("foxglove")

from foxglove_client import Schemas, grid_of, points_of, pose_of, stamp_of, to_matrix  # noqa: E402
from stillmap.live.foxglove import schemas  # noqa: E402
from stillmap.live.foxglove.answer import Answer, Movers, pack_answer, unpack_answer  # noqa: E402
from stillmap.live.foxglove.mailbox import Mailbox  # noqa: E402
from stillmap.live.foxglove.tile_map import TileMap, join_cells, to_percent  # noqa: E402

import stillmap  # noqa: E402
from stillmap.core import se2, se3  # noqa: E402
from stillmap.live.causal_labels import MapChange  # noqa: E402

NAN = np.nan
STAMP = 1_700_000_000_123_456_789


def read(message):
    """A message as its readers see it."""
    schema = message.get_schema()
    return Schemas(schema.data).read(f".{schema.name}", message.encode())


def pose_3d():
    return se3.exp(np.array([1.0, 2.0, 3.0, 0.3, -0.5, 2.0]))


def make_movers(dimension, n):
    k = np.arange(n, dtype=np.float64)[:, None]
    velocity = np.pad(np.repeat([[0.0, 1.5]], n, axis=0), [(0, 0), (0, dimension - 2)])
    return Movers(np.arange(n) + 7, k + np.arange(dimension), velocity, np.full(n, 0.3))


def make_answer(dimension, **changes):
    T = se2.matrix(1.0, 2.0, 3.0) if dimension == 2 else pose_3d()
    mount = np.eye(dimension + 1)
    mount[0, dimension] = 0.5
    odometry = np.eye(dimension + 1)
    odometry[1, dimension] = 7.0
    points = np.arange(4 * dimension, dtype=np.float32).reshape(4, dimension)
    hit, p_static = np.array([True, True, False, True]), np.float32([0.9, 0.2, 0.5, NAN])
    given = {
        "stamp_ns": STAMP,
        "sensor": 0,
        "points": points,
        "hit": hit,
        "p_static": p_static,
        "T_map_base": T,
        "T_base_sensor": mount,
        "T_map_odom": T @ se2.inverse(odometry),
        "doubts": (),
        "movers": make_movers(dimension, 0),
    }
    return Answer(**(given | changes))


def embedded(T):
    """(4, 4) of a pose in the plane or in space."""
    if len(T) == 4:
        return T
    out = np.eye(4)
    out[:2, :2], out[:2, 3] = T[:2, :2], T[:2, 2]
    return out


dimensions = pytest.mark.parametrize("dimension", [2, 3])


@dimensions
def test_pose(dimension):
    answer = make_answer(dimension)
    message = read(schemas.to_pose_in_frame(answer))
    assert message["frame_id"] == "map"
    assert stamp_of(message) == STAMP
    np.testing.assert_allclose(pose_of(message["pose"]), embedded(answer.T_map_base), atol=1e-12)


@dimensions
def test_transforms_lead_from_map_to_robot(dimension):
    answer = make_answer(dimension)
    odom, base = read(schemas.to_transforms(answer))["transforms"]
    assert (odom["parent_frame_id"], odom["child_frame_id"]) == ("map", "odom")
    assert (base["parent_frame_id"], base["child_frame_id"]) == ("odom", "base")
    T = [to_matrix(one["translation"], one["rotation"]) for one in (odom, base)]
    np.testing.assert_allclose(T[0], embedded(answer.T_map_odom), atol=1e-12)
    np.testing.assert_allclose(T[0] @ T[1], embedded(answer.T_map_base), atol=1e-12)
    (only,) = read(schemas.to_transforms(make_answer(dimension, T_map_odom=None)))["transforms"]
    assert (only["parent_frame_id"], only["child_frame_id"]) == ("map", "base")
    np.testing.assert_allclose(
        to_matrix(only["translation"], only["rotation"]), embedded(answer.T_map_base), atol=1e-12
    )


@dimensions
def test_clouds_split_the_hits(dimension):
    answer = make_answer(dimension)
    static, dynamic = (read(cloud) for cloud in schemas.to_clouds(answer))
    T = embedded(answer.T_map_base) @ embedded(answer.T_base_sensor)
    for cloud, beam in ((static, 0), (dynamic, 1)):
        assert stamp_of(cloud) == STAMP
        assert cloud["frame_id"] == "map"
        points, p_static = points_of(cloud)
        expected = np.zeros(4)
        expected[:dimension], expected[3] = answer.points[beam], 1.0
        np.testing.assert_allclose(points, [(T @ expected)[:3]], atol=1e-5)
        np.testing.assert_array_equal(p_static, answer.p_static[beam : beam + 1])


def test_a_scan_without_hits():
    answer = make_answer(2, hit=np.zeros(4, np.bool_))
    for cloud in schemas.to_clouds(answer):
        assert "data" not in read(cloud)


@pytest.mark.parametrize(
    ("stamp", "expected"), [(-5, 999_999_995), (0, 0), (2**62, (2**32 - 1) * 10**9)]
)
def test_stamps_that_the_schema_cannot_hold(stamp, expected):
    answer = make_answer(2, stamp_ns=stamp)
    got = stamp_of(read(schemas.to_pose_in_frame(answer)))
    assert abs(got - expected) < 10**9


def test_path():
    positions = np.array([[0.0, 0.0], [1.0, 0.5], [2.0, 0.0]])
    for dimension in (2, 3):
        given = np.pad(positions, [(0, 0), (0, dimension - 2)])
        (entity,) = read(schemas.to_path(given, STAMP))["entities"]
        assert (entity["id"], entity["frame_id"]) == ("path", "map")
        points = entity["lines"][0]["points"]
        np.testing.assert_array_equal([[p.get("x", 0), p.get("y", 0)] for p in points], positions)
    long = np.stack([np.arange(20_000.0), np.zeros(20_000)], axis=1)
    (entity,) = read(schemas.to_path(long, STAMP))["entities"]
    assert 2000 < len(entity["lines"][0]["points"]) <= 5000


@dimensions
def test_movers(dimension):
    answer = make_answer(dimension, movers=make_movers(dimension, 2))
    message = read(schemas.to_movers(answer))
    (deletion,) = message["deletions"]
    assert deletion["type"] == foxglove.messages.SceneEntityDeletionType.All.value
    assert stamp_of(deletion) == STAMP
    assert [entity["id"] for entity in message["entities"]] == ["7", "8"]
    for k, entity in enumerate(message["entities"]):
        assert stamp_of(entity) == STAMP
        body, arrow = entity["cylinders"][0], entity["arrows"][0]
        at = pose_of(body["pose"])[:3, 3]
        np.testing.assert_allclose(at[:dimension], k + np.arange(dimension))
        assert body["size"]["x"] == pytest.approx(0.6)
        assert arrow["shaft_length"] + arrow["head_length"] == pytest.approx(1.5)
        np.testing.assert_allclose(pose_of(arrow["pose"])[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)
        assert entity["texts"][0]["text"] == entity["id"]
    nobody = read(schemas.to_movers(make_answer(dimension)))
    assert "entities" not in nobody
    assert len(nobody["deletions"]) == 1


def test_doubts():
    quiet = read(schemas.to_log((), STAMP))
    loud = read(schemas.to_log(("slip", "lost"), STAMP))
    assert quiet["level"] < loud["level"]
    assert "odometry" in loud["message"]
    assert "the map is not known" in loud["message"]
    assert stamp_of(loud) == STAMP


@dimensions
@pytest.mark.parametrize("sensor", [0, 3, "front/scan"])
def test_answers_pass_between_processes(dimension, sensor):
    for changes in ({}, {"T_map_odom": None, "doubts": ("blind", "lost")}):
        movers = make_movers(dimension, 2 if changes else 0)
        answer = make_answer(dimension, sensor=sensor, movers=movers, **changes)
        back = unpack_answer(pack_answer(answer))
        for name, value in vars(answer).items():
            if name != "movers":
                np.testing.assert_array_equal(getattr(back, name), value)
        for got, expected in zip(back.movers, answer.movers, strict=True):
            np.testing.assert_array_equal(got, expected)


def tile(x, y, value=NAN, **cells):
    p = np.full((32, 32), value, np.float32)
    for at, one in cells.get("cells", {}).items():
        p[at] = one
    return MapChange(np.array([x, y]), p)


def test_tiles_make_a_grid():
    tiles = TileMap()
    tiles.add([tile(-32, 0, cells={(3, 5): 1.0}), tile(32, 32, 0.0)], 0.1)
    cells = tiles.to_cells()
    assert cells.percent.shape == (64, 96)
    np.testing.assert_allclose(cells.origin, [-3.2, 0.0])
    assert cells.percent[3, 5] == 100
    assert (cells.percent[32:, 64:] == 0).all()
    assert (cells.percent == 255).sum() == 64 * 96 - 1 - 32 * 32
    corner, edge, percent = grid_of(read(schemas.to_grid(cells, STAMP)))
    np.testing.assert_allclose(corner, cells.origin)
    assert edge == pytest.approx(0.1)
    np.testing.assert_array_equal(percent, cells.percent)
    tiles.add([tile(32, 32), tile(-32, 0, 0.5)], 0.1)  # one is gone
    assert tiles.to_cells().percent.shape == (32, 32)
    assert (tiles.to_cells().percent == 50).all()


def test_unknown_cells_are_transparent():
    tiles = TileMap()
    tiles.add([tile(0, 0, cells={(0, 0): 1.0, (0, 1): 0.0})], 0.1)
    message = read(schemas.to_grid(tiles.to_cells(), STAMP))
    at = {field["name"]: field.get("offset", 0) for field in message["fields"]}
    rows = np.frombuffer(message["data"], np.uint8).reshape(-1, message["cell_stride"])
    assert rows[:3, at["alpha"]].tolist() == [255, 255, 0]
    assert rows[0, at["red"]] < 50 < 200 < rows[1, at["red"]]


def test_large_maps_are_shown_in_larger_cells():
    tiles = TileMap()
    tiles.add([tile(0, 0, 0.0, cells={(4, 4): 1.0}), tile(320, 320, NAN, cells={(0, 0): 0.3})], 0.1)
    cells = tiles.to_cells(max_cells=20_000)
    assert cells.percent.size <= 20_000
    assert cells.edge == pytest.approx(0.3)
    assert cells.percent[1, 1] == 100
    assert cells.percent[0, 0] == 0
    assert cells.percent[106, 106] == 30
    assert cells.percent[50, 50] == 255


def test_cells_are_joined():
    np.testing.assert_array_equal(
        join_cells(np.array([[0, 255, 255], [70, 10, 255], [1, 2, 255]], np.uint8), 2),
        [[70, 255], [2, 255]],
    )
    np.testing.assert_array_equal(to_percent(np.float32([NAN, 0.0, 0.496, 1.0])), [255, 0, 50, 100])


def test_occupied_voxels():
    p = np.full((8, 8, 8), NAN, np.float32)
    p[1, 2, 3], p[0, 0, 0] = 0.9, 0.2  # z, y, x
    tiles = TileMap()
    tiles.add([MapChange(np.array([8, 0, -8]), p)], 0.5)
    assert tiles.dimension == 3
    expected = [[(8 + 3.5) * 0.5, 2.5 * 0.5, (-8 + 1.5) * 0.5]]
    np.testing.assert_allclose(tiles.to_points(), expected)
    points, _ = points_of(read(schemas.to_map_cloud(tiles.to_points(), STAMP)))
    np.testing.assert_allclose(points, expected)
    many = TileMap()
    many.add([MapChange(np.array([0, 0, 0]), np.ones((8, 8, 8), np.float32))], 0.5)
    assert 50 <= len(many.to_points(max_points=100)) <= 100


def test_a_mailbox_keeps_the_newest():
    mailbox = Mailbox()
    for k in range(3):
        mailbox.put_answer(make_answer(2, stamp_ns=k))
    mailbox.put_answer(make_answer(2, sensor="rear", stamp_ns=7))
    for k in range(100):
        mailbox.put_changes([tile(32 * (k % 4), 0, k / 100)], 0.1)
    mail = mailbox.take()
    assert {sensor: one.stamp_ns for sensor, one in mail.answers.items()} == {0: 2, "rear": 7}
    tiles = TileMap()
    for several in mail.changes:
        tiles.add(several, 0.1)
    assert sum(map(len, mail.changes)) < 50  # not all that were put in
    np.testing.assert_array_equal(tiles.to_cells().percent[0, ::32], [96, 97, 98, 99])
    assert mailbox.take(0.01).answers == {}
    mailbox.close()
    assert mailbox.take() is None


def test_what_the_mapper_answers_is_what_is_shown(corridor):
    """The parts that changed, put together, are the map."""
    tiles = TileMap()
    with stillmap.LiveMapper({"threads": 1}) as mapper:
        for k, beams in enumerate(corridor.beams):
            update = mapper.push(beams, corridor.recording.T_odom_base[k])
            tiles.add(update.changes, 0.05)
            if k > 40:
                break
        tiles.add(mapper._slam.labels.take_changes(beams.stamp_ns + 10**9), 0.05)
        grid = mapper.map
    cells = tiles.to_cells()
    np.testing.assert_allclose(cells.origin, grid.origin[:2])
    np.testing.assert_array_equal(cells.percent, to_percent(grid.p_occupied))
