"""The node against a robot and a judge that speak DDS by another library than ROS does."""

import signal

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here: make test-ros makes an environment with it")
pytest.importorskip("cyclonedds", reason="the judge is not here: make test-ros installs it")

import ros_idl as idl
from dds import wait_for
from judge import planar, poses_of, stamp_of, truth_at

import stillmap
from stillmap.core import se2
from stillmap.results.eval.trajectory import compute_absolute_errors


def test_a_whole_run_with_tf(simulation, judge, tf_environment, start_node, start_robot, tmp_path):
    node = start_node(tf_environment, "map_update_interval:=1.0")
    robot, sent = start_robot("--tf")
    assert wait_for(lambda: len(judge.poses) == 400, 60.0), node.text + robot.text
    assert robot.wait() == 0

    # every scan is answered with its own stamp, soon, and right
    sent_at = {line["stamp_ns"]: line["sent"] for line in sent()}
    stamps = [stamp_of(one) for one in judge.poses]
    assert stamps == sorted(sent_at)
    latency = np.array([one.at - sent_at[stamp_of(one)] for one in judge.poses])
    print(f"latency ms: {np.quantile(1e3 * latency, (0.5, 0.99, 1.0)).round(1)}")
    assert np.median(latency) < 0.05  # machines that test do other things too
    errors = compute_absolute_errors(poses_of(judge.poses), truth_at(simulation, stamps))
    assert errors.rmse < 0.05
    assert judge.poses[-1].message.header.frame_id == "map"
    assert judge.poses[-1].message.pose.covariance[0] > 0.0

    check_transforms(simulation.recording, judge)
    check_labels(simulation, judge)
    check_points(simulation.recording, judge)
    check_movers(simulation, judge)
    check_map(simulation, judge.maps[-1].message)
    check_updates(judge)
    assert int(judge.values["scans"]) <= 400
    assert judge.values["odometry"] == "TF"

    # who comes later gets the last map
    late = judge.read_map()
    assert wait_for(lambda: late)
    assert late[0].message.data == judge.maps[-1].message.data

    node.send(signal.SIGINT)
    node.send(signal.SIGTERM)  # as launch does, when it loses patience
    assert node.wait() == 0, node.text
    result = stillmap.load(tmp_path / "result")
    assert len(result.poses) == 400
    assert len(np.load(tmp_path / "result/live/beams/p_static.npy")) == 400 * 180


def check_transforms(recording, judge):
    """map -> odom and the odometry make the pose; it holds a little longer than the scan."""
    poses = {stamp_of(one): T for one, T in zip(judge.poses, poses_of(judge.poses), strict=True)}
    odometry = dict(zip(recording.stamp_ns.tolist(), recording.T_odom_base, strict=True))
    ours = [
        one
        for received in judge.tf
        for one in received.message.transforms
        if one.header.frame_id == "map"
    ]
    assert len(ours) > 300
    for one in ours:
        assert one.child_frame_id == "odom"
        stamp = one.header.stamp.sec * 10**9 + one.header.stamp.nanosec - 200_000_000
        T = planar(one.transform.translation, one.transform.rotation)
        np.testing.assert_allclose(T @ odometry[stamp], poses[stamp], atol=1e-5)


def check_labels(simulation, judge):
    """Each beam is among what stands or among what moves, and mostly rightly so."""
    recording, scans = simulation.recording, {}
    for one in judge.static:
        scans[stamp_of(one)] = [one.message]
    for one in judge.dynamic:
        scans[stamp_of(one)].append(one.message)
    right = said = there = 0
    for t, stamp in enumerate(recording.stamp_ns.tolist()):
        static, dynamic = scans[stamp]
        beams = recording.beams_of(t)
        hit, moves = recording.hit[beams], ~simulation.truth.static[beams]
        among_static, among_dynamic = (np.isfinite(one.ranges) for one in (static, dynamic))
        np.testing.assert_array_equal(among_static ^ among_dynamic, hit)
        length = np.linalg.norm(recording.points[beams], axis=1)
        both = np.where(among_static, static.ranges, dynamic.ranges)[hit]
        np.testing.assert_allclose(both, length[hit], rtol=1e-5)
        assert (static.header.frame_id, static.angle_min) == ("laser", dynamic.angle_min)
        right += (among_dynamic & moves & hit).sum()
        said, there = said + among_dynamic.sum(), there + (moves & hit).sum()
    assert 2 * right / (said + there) > 0.85  # F1


def check_points(recording, judge):
    """All end points, with the labels by which the scan was split."""
    number = dict(zip(recording.stamp_ns.tolist(), range(recording.n_scans), strict=True))
    static = {stamp_of(one): np.array(one.message.ranges) for one in judge.static}
    assert len(judge.points) == 400
    for one in judge.points[::40]:
        message, stamp = one.message, stamp_of(one)
        assert [f.name for f in message.fields] == ["x", "y", "z", "p_static"]
        values = np.frombuffer(bytes(message.data), np.float32).reshape(-1, 4)
        beams = recording.beams_of(number[stamp])
        hit = recording.hit[beams]
        np.testing.assert_allclose(values[:, :2], recording.points[beams][hit], atol=1e-4)
        np.testing.assert_array_equal(values[:, 3] >= 0.5, np.isfinite(static[stamp])[hit])


def check_movers(simulation, judge):
    """Nearly all are where somebody is, and there are some of those who walk."""
    number = dict(zip(simulation.recording.stamp_ns.tolist(), range(400), strict=True))
    T = se2.inverse(simulation.truth.T_world_base[0])
    people = simulation.truth.movers[..., :2] @ T[:2, :2].T + T[:2, 2]
    said = right = 0
    for one in judge.mover_poses:
        at = np.array([[p.position.x, p.position.y] for p in one.message.poses]).reshape(-1, 2)
        off = np.linalg.norm(at[:, None] - people[number[stamp_of(one)]], axis=2)
        said, right = said + len(at), right + int((off.min(axis=1, initial=np.inf) < 0.6).sum())
    assert len(judge.mover_poses) == 400
    assert said > 200
    assert right > 0.85 * said
    shown, most = set(), 0
    for one in judge.movers:
        for marker in one.message.markers:
            if marker.action == 3:
                shown.clear()
            else:
                shown.add((marker.ns, marker.id))
        most = max(most, len(shown))
    last = len(judge.mover_poses[-1].message.poses)
    assert len(shown) == 2 * last  # whoever is gone was removed
    assert most >= 4


def check_updates(judge):
    """The maps and what changed between them make the last map."""
    assert len(judge.updates) > 10
    grid = None
    for one in sorted([*judge.maps[:-1], *judge.updates], key=lambda one: one.at):
        message = one.message
        if isinstance(message, idl.OccupancyGrid):
            grid = np.array(message.data).reshape(message.info.height, message.info.width)
            continue
        if grid is not None:
            rows, columns = (
                slice(message.y, message.y + message.height),
                slice(message.x, message.x + message.width),
            )
            assert grid[rows, columns].size == len(message.data)
            grid[rows, columns] = np.array(message.data).reshape(message.height, message.width)
    last = judge.maps[-1].message
    expected = np.array(last.data).reshape(last.info.height, last.info.width)
    assert grid.shape == expected.shape
    known = expected >= 0
    assert np.mean(grid[known] == expected[known]) > 0.97


def check_map(simulation, grid):
    assert grid.header.frame_id == "map"
    cells = np.array(grid.data).reshape(grid.info.height, grid.info.width)
    assert set(np.unique(cells)) == {-1, 0, 100}
    rows, columns = np.nonzero(cells == 100)
    assert len(rows) > 500
    corner = grid.info.origin.position
    at = (np.stack([columns, rows], axis=1) + 0.5) * grid.info.resolution + [corner.x, corner.y]
    T = simulation.truth.T_world_base[0]  # the map has the frame of the first scan
    at = at @ T[:2, :2].T + T[:2, 2]
    a, b = simulation.truth.walls[:, :2], simulation.truth.walls[:, 2:]
    along = np.einsum("nwd,wd->nw", at[:, None] - a, b - a) / ((b - a) ** 2).sum(axis=1)
    nearest = a + np.clip(along, 0, 1)[..., None] * (b - a)
    assert np.mean(np.linalg.norm(at[:, None] - nearest, axis=2).min(axis=1) < 0.15) > 0.97


@pytest.mark.parametrize(
    ("parameter", "says"),
    [
        ("resolution:=-1.0", "'resolution' must be more than 0, got -1.0"),
        ("map_frame:=3", "'map_frame' must be a text, got 3"),
        ("resolution=", "arguments of ROS"),
    ],
)
def test_wrong_parameters_are_named_in_one_line(tf_environment, start_node, parameter, says):
    node = start_node(tf_environment, parameter)
    assert node.wait() == 2
    assert says in node.text
    assert "Traceback" not in node.text
