"""The node against a robot and a judge that speak DDS by another library than ROS does."""

import math
import signal
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here: make test-ros makes an environment with it")
pytest.importorskip("cyclonedds", reason="the judge is not here: make test-ros installs it")

import ros_idl as idl
from dds import Participant, wait_for

import stillmap
from stillmap.core import se2
from stillmap.eval.trajectory import compute_absolute_errors


class Judge:
    """Reads what the node says."""

    def __init__(self, participant):
        self._participant = participant
        self.poses = participant.read(idl.PoseWithCovarianceStamped, "pose", reliable=True)
        self.maps = self.read_map()
        self.static = participant.read(idl.LaserScan, "scan_static", reliable=True)
        self.dynamic = participant.read(idl.LaserScan, "scan_dynamic", reliable=True)
        self.points = participant.read(idl.PointCloud2, "scan_points", reliable=True)
        self.updates = participant.read(idl.OccupancyGridUpdate, "map_updates", reliable=True)
        self.movers = participant.read(idl.MarkerArray, "movers", reliable=True)
        self.mover_poses = participant.read(idl.PoseArray, "mover_poses", reliable=True)
        self.tf = participant.read(idl.TFMessage, "tf", depth=100, reliable=True)
        self.diagnostics = participant.read(idl.DiagnosticArray, "diagnostics", reliable=True)

    def read_map(self):
        """A reader of its own, as one that comes later has."""
        return self._participant.read(
            idl.OccupancyGrid, "map", depth=1, reliable=True, latched=True
        )

    @property
    def values(self):
        """The last diagnostics."""
        return {one.key: one.value for one in self.diagnostics[-1].message.status[0].values}


@pytest.fixture
def participant(domain):
    made = Participant(domain)
    yield made
    made.close()


@pytest.fixture
def judge(participant):
    return Judge(participant)


def stamp_of(received):
    stamp = received.message.header.stamp
    return stamp.sec * 10**9 + stamp.nanosec


def planar(position, q):
    return se2.matrix(position.x, position.y, 2 * math.atan2(q.z, q.w))


def poses_of(received):
    pose = [one.message.pose.pose for one in received]
    return np.array([planar(one.position, one.orientation) for one in pose])


def laser_pose(recording):
    values = se2.parameters(recording.T_base_sensor[0])
    return f"laser_pose:=[{', '.join(f'{value:.6f}' for value in values)}]"


def truth_at(simulation, stamps):
    index = np.searchsorted(simulation.recording.stamp_ns, stamps)
    T = simulation.truth.T_world_base
    return T[index]


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
            key = marker.ns, marker.id
            (shown.add if marker.action == 0 else shown.remove)(key)
        most = max(most, len(shown))
    last = len(judge.mover_poses[-1].message.poses)
    assert len(shown) == 3 * last  # whoever is gone was removed
    assert most >= 6


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


def test_lost_swapped_and_odd_stamps_and_a_robot_that_dies(
    simulation, judge, environment, start_node, start_robot, tmp_path
):
    """Without tf2_msgs: odometry from its topic, and the pose alone."""
    node = start_node(environment, laser_pose(simulation.recording), "use_sim_time:=true")
    robot, sent = start_robot(
        *("--lose", "0.02", "--swap", "0.02", "--jump", "50", "--jump", "51", "--leap", "90")
    )
    assert wait_for(lambda: len(judge.poses) > 150, 60.0), node.text + robot.text
    robot.kill()
    assert "tf2_msgs is missing" in node.text
    assert "map_msgs is missing" in node.text
    lines = sent()
    # what came late, and what nobody can believe
    kept, last = [], 0
    for line in lines:
        is_odd = line["scan"] in (50, 51, 90)
        if line["stamp_ns"] > last and not is_odd:
            kept.append(line["stamp_ns"])
            last = line["stamp_ns"]
    assert wait_for(lambda: len(judge.poses) >= len(kept) - 2)
    stamps = [stamp_of(one) for one in judge.poses]
    assert len(set(kept) - set(stamps)) <= 2  # on their way when the robot died
    assert stamps == sorted(set(stamps))
    assert wait_for(lambda: "stamp far ahead of the scan before" in judge.values, 5.0)
    assert int(judge.values["stamp before that of an earlier scan"]) >= 2
    assert not judge.tf

    # another robot process goes on where the first one died
    before = len(judge.poses)
    first = lines[-1]["scan"] + 10
    robot, sent = start_robot("--first", str(first))
    assert wait_for(lambda: len(judge.poses) == before + 400 - first, 60.0), node.text
    assert node.is_running
    stamps = [stamp_of(one) for one in judge.poses]
    errors = compute_absolute_errors(poses_of(judge.poses), truth_at(simulation, stamps))
    assert errors.rmse < 0.08
    node.send(signal.SIGTERM)
    assert node.wait() == 0, node.text
    assert len(stillmap.load(tmp_path / "result").poses) == len(judge.poses)


def test_a_clock_that_is_set_back_is_told(
    simulation, judge, environment, start_node, start_robot, tmp_path
):
    node = start_node(environment, laser_pose(simulation.recording))
    robot, _ = start_robot("--last", "60", "--shift", "3600")
    assert wait_for(lambda: len(judge.poses) == 60, 60.0), node.text
    assert robot.wait() == 0
    start_robot("--last", "200")
    text = "clock set back by 3"
    assert wait_for(lambda: any(text in status(one) for one in judge.diagnostics), 30.0)
    assert node.text.count("clock set back") == 1
    assert len(judge.poses) == 60
    node.send(signal.SIGINT)
    assert node.wait() == 0, node.text
    assert len(stillmap.load(tmp_path / "result").poses) == 60


def status(received):
    return received.message.status[0].message


def test_a_bag_that_is_played_again_begins_a_new_map(
    simulation, judge, tf_environment, start_node, start_robot, tmp_path
):
    node = start_node(tf_environment, "use_sim_time:=true")
    robot, _ = start_robot("--tf", "--first", "60", "--last", "120", "--shift", "3600")
    assert wait_for(lambda: len(judge.poses) == 60, 60.0), node.text
    assert robot.wait() == 0
    start_robot("--tf", "--last", "300", "--period", "0.04")
    assert wait_for(lambda: len(judge.poses) > 100, 60.0), node.text
    received = judge.poses[60:]
    stamps = [stamp_of(one) for one in received]
    origins = truth_at(simulation, stamps) @ se2.inverse(poses_of(received))
    assert np.ptp(origins[:, :2, 2], axis=0).max() < 0.1
    assert "a new map begins" in node.text
    ours = [t for one in judge.tf for t in one.message.transforms if t.header.frame_id == "map"]
    assert ours[-1].header.stamp.sec < ours[0].header.stamp.sec
    node.send(signal.SIGINT)
    assert node.wait() == 0, node.text
    assert len(stillmap.load(tmp_path / "result-before").poses) == 60
    assert 40 < len(stillmap.load(tmp_path / "result").poses) < 300


def test_a_node_that_is_killed_can_be_started_again(
    simulation, judge, environment, start_node, start_robot
):
    first = start_node(environment, laser_pose(simulation.recording))
    robot, _ = start_robot("--period", "0.05")
    assert wait_for(lambda: len(judge.poses) > 50, 60.0), first.text + robot.text
    first.kill()
    before, maps = len(judge.poses), len(judge.maps)
    second = start_node(environment, laser_pose(simulation.recording))
    assert wait_for(lambda: len(judge.poses) > before + 30, 60.0), second.text
    # it begins anew: its map has the frame of its own first scan, on the robot's way
    received = judge.poses[before:]
    T_world_base = truth_at(simulation, [stamp_of(one) for one in received])
    origins = T_world_base @ se2.inverse(poses_of(received))
    assert np.ptp(origins[:, :2, 2], axis=0).max() < 0.1
    way = simulation.truth.T_world_base[:, :2, 2]
    distance = np.linalg.norm(way - origins[0, :2, 2], axis=1)
    assert distance.min() < 0.05
    assert distance[:50].min() > 0.1
    assert wait_for(lambda: len(judge.maps) > maps)
    assert robot.is_running


def test_the_map_is_saved_on_demand_while_mapping_goes_on(
    simulation, judge, environment, start_node, start_robot, tmp_path
):
    node = start_node(environment, laser_pose(simulation.recording))
    start_robot()
    assert wait_for(lambda: len(judge.poses) > 100, 60.0), node.text
    answer = subprocess.run(
        [sys.executable, "-c", CALL], env=environment, capture_output=True, text=True, timeout=60
    )
    assert answer.stdout.startswith("True wrote"), answer.stdout + answer.stderr + node.text
    saved = len(stillmap.load(tmp_path / "result").poses)
    assert 100 < saved <= 400
    assert wait_for(lambda: len(judge.poses) == 400, 60.0), "mapping did not go on"
    node.send(signal.SIGINT)
    assert node.wait() == 0, node.text
    assert len(stillmap.load(tmp_path / "result").poses) == 400


CALL = """
import rclpy
from std_srvs.srv import Trigger
rclpy.init()
node = rclpy.create_node("caller")
client = node.create_client(Trigger, "/stillmap/save_map")
assert client.wait_for_service(20.0)
future = client.call_async(Trigger.Request())
rclpy.spin_until_future_complete(node, future, timeout_sec=40.0)
print(future.result().success, future.result().message)
"""


def test_a_robot_without_odometry_is_mapped_too(
    simulation, judge, tf_environment, start_node, start_robot
):
    node = start_node(tf_environment, 'odom_frame:=""')
    start_robot("--tf", "--last", "150")
    assert wait_for(lambda: len(judge.poses) == 150, 60.0), node.text
    stamps = [stamp_of(one) for one in judge.poses]
    errors = compute_absolute_errors(poses_of(judge.poses), truth_at(simulation, stamps))
    assert errors.rmse < 0.1
    ours = [t for one in judge.tf for t in one.message.transforms if t.header.frame_id == "map"]
    assert {one.child_frame_id for one in ours} == {"base_footprint"}


def test_two_lasers(simulation, judge, participant, tf_environment, start_node, start_robot):
    of_each = [
        participant.read(idl.LaserScan, f"{topic}_static", reliable=True)
        for topic in ("scan_right", "scan_left")
    ]
    start_node(tf_environment, 'scan_topic:=["scan_right", "scan_left"]')
    # 20 of each in a second: who maps more than comes is not what is tested
    start_robot("--tf", "--split", "--last", "150", "--period", "0.05")
    assert wait_for(lambda: len(judge.poses) == 300, 60.0), str((len(judge.poses), judge.values))
    stamps = [stamp_of(one) for one in judge.poses]
    assert stamps == sorted(stamps)
    errors = compute_absolute_errors(poses_of(judge.poses), truth_at(simulation, stamps))
    assert errors.rmse < 0.05
    assert wait_for(lambda: all(len(scans) == 150 for scans in of_each))
    assert {one.message.angle_min < -1.5 for one in of_each[0]} == {True}
    assert {one.message.angle_min > -0.1 for one in of_each[1]} == {True}


def test_sweeps_of_a_lidar(
    sweeps, judge, participant, tf_environment, start_node, start_robot, tmp_path
):
    simulation, path = sweeps
    clouds = {
        name: participant.read(idl.PointCloud2, f"points_{name}", reliable=True)
        for name in ("static", "dynamic", "points")
    }
    node = start_node(tf_environment, "cloud_topic:=points", "map_update_interval:=1.0")
    robot, _ = start_robot("--tf", "--period", "0.2", recording=path)
    assert wait_for(lambda: len(judge.poses) == 60, 90.0), node.text + robot.text
    stamps = [stamp_of(one) for one in judge.poses]
    T = truth_at(simulation, stamps)
    true = (se2.inverse(T[0]) @ T)[:, :3, 3]
    poses = [one.message.pose.pose for one in judge.poses]
    found = np.array([[p.position.x, p.position.y, p.position.z] for p in poses])
    assert np.linalg.norm(found - true, axis=1).max() < 0.5
    assert wait_for(lambda: all(len(one) == 60 for one in clouds.values()))
    for static, dynamic, every in zip(*clouds.values(), strict=True):
        widths = [one.message.width for one in (static, dynamic, every)]
        assert widths[0] + widths[1] == widths[2] > 1000
        assert every.message.header.frame_id == "laser"
    assert wait_for(lambda: judge.maps)
    assert 100 in judge.maps[-1].message.data
    node.send(signal.SIGINT)
    assert node.wait() == 0, node.text
    assert len(stillmap.load(tmp_path / "result").poses) == 60


@pytest.mark.parametrize(
    ("parameter", "says"),
    [
        ("resolution:=-1.0", "parameter resolution: expected more than 0, got -1.0"),
        ("map_frame:=3", "parameter map_frame: expected text, got 3"),
        ("resolution=", "arguments of ROS"),
    ],
)
def test_wrong_parameters_are_told_in_one_line(environment, start_node, parameter, says):
    node = start_node(environment, parameter)
    assert node.wait() == 2
    assert says in node.text
    assert "Traceback" not in node.text
