"""`stillmap live --foxglove`, seen by a client of its own."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

foxglove = pytest.importorskip("foxglove")

from foxglove_client import Client, Schemas, grid_of, points_of, pose_of, stamp_of  # noqa: E402

from stillmap.cli.main import main  # noqa: E402
from stillmap.core.grid_map import GridMap  # noqa: E402
from stillmap.em import CellProbabilities  # noqa: E402
from stillmap.live import foxglove_server  # noqa: E402
from stillmap.live.foxglove_server import FoxgloveServer  # noqa: E402
from stillmap.live.movers import Mover  # noqa: E402
from stillmap.live.scan import Scan, to_beams  # noqa: E402
from stillmap.live.update import Update  # noqa: E402
from stillmap.sim import scene_by_name, simulate, write_simulation  # noqa: E402

TOPICS = ("/map", "/pose", "/path", "/tf", "/doubts", "/movers", "/scan_static", "/scan_dynamic")
KINDS = ("static", "dynamic")
STAMP = foxglove_server.to_timestamp(1_700_000_000_123_456_789)


@pytest.fixture
def server():
    with FoxgloveServer(port=0) as made:
        yield made


@pytest.fixture(scope="module")
def hall(tmp_path_factory):
    folder = tmp_path_factory.mktemp("foxglove") / "hall"
    write_simulation(simulate(scene_by_name("hall", {"robot": {"scans": 80}}), 1), folder)
    return folder


def show(server, run, scans, pause=0.0):
    """Show some scans of a run as if they were answered now."""
    for k in scans:
        server.show(run.mapper, run.beams[k], run.updates[k])
        time.sleep(pause)


def wait_until_subscribed(server, run, client, topics):
    """Show a scan again and again until all topics have arrived."""

    def is_subscribed(client):
        show(server, run, [0], pause=0.01)  # which brings another message
        return client.received.keys() >= set(topics)

    client.wait(is_subscribed)


def last_pose_is(run, k):
    def is_so(client):
        poses = client.received.get("/pose", [])
        return bool(poses) and stamp_of(poses[-1]) == run.beams[k].stamp_ns

    return is_so


def percent_of(p_occupied):
    known = ~np.isnan(p_occupied)
    return np.where(known, np.rint(100.0 * np.where(known, p_occupied, 0.0)), 255).astype(np.uint8)


def test_a_client_sees_what_the_mapper_answered(server, corridor):
    with Client(server.url) as client:
        client.subscribe(*TOPICS)
        assert client.info["name"] == "stillmap"
        assert client.info["capabilities"] == ["time"]  # nobody may publish, call, or set anything
        show(server, corridor, [0])  # its sensor has topics now
        wait_until_subscribed(server, corridor, client, TOPICS)
        client.received["/path"].clear()
        show(server, corridor, range(120, 200), pause=0.02)
        client.wait(last_pose_is(corridor, 199))
        client.wait(lambda client: client.received["/path"])
    stamps = {beams.stamp_ns: k for k, beams in enumerate(corridor.beams)}
    given = [(stamps[stamp_of(pose)], pose) for pose in client.received["/pose"]]
    assert [k for k, _ in given] == sorted(k for k, _ in given)
    for k, pose in given:
        assert pose["log_time"] == corridor.beams[k].stamp_ns
        T = pose_of(pose["pose"])
        np.testing.assert_allclose(T[:2, :2], corridor.updates[k].pose[:2, :2], atol=1e-12)
        np.testing.assert_allclose(T[:2, 3], corridor.updates[k].pose[:2, 2], atol=1e-12)
    corner, edge, percent = grid_of(client.received["/map"][-1])
    grid = corridor.mapper.map
    np.testing.assert_allclose(corner, grid.origin[:2])
    assert edge == pytest.approx(0.05)
    np.testing.assert_array_equal(percent, percent_of(grid.p_occupied))
    assert client.times[-1] == corridor.beams[199].stamp_ns
    assert len(client.received["/tf"][-1]["transforms"]) == 2
    check_clouds(client, corridor, stamps)
    check_movers(client, corridor, stamps)
    points = client.received["/path"][-1]["entities"][0]["lines"][0]["points"]
    path = np.array([[point.get("x", 0.0), point.get("y", 0.0)] for point in points])
    np.testing.assert_allclose(path, corridor.mapper.path[:, :2, 2])


def check_clouds(client, run, stamps):
    """Static and dynamic points are the hits of their scan, in the map."""
    n_dynamic = 0
    for label in ("static", "dynamic"):
        for cloud in client.received[f"/scan_{label}"]:
            k = stamps[stamp_of(cloud)]
            beams, update = run.beams[k], run.updates[k]
            kept = beams.hit & ((update.p_static < 0.5) == (label == "dynamic"))
            T = update.pose @ beams.T_base_sensor
            points, p_static = points_of(cloud)
            expected = beams.points[kept] @ T[:2, :2].T + T[:2, 2]
            np.testing.assert_allclose(points[:, :2], expected, atol=1e-4)
            np.testing.assert_array_equal(p_static, update.p_static[kept])
            assert not points[:, 2].any()
            n_dynamic += len(points) if label == "dynamic" else 0
    assert n_dynamic > 20


def check_movers(client, run, stamps):
    n_movers = 0
    for message in client.received["/movers"]:
        movers = run.updates[stamps[message["log_time"]]].movers
        entities = message.get("entities", [])
        assert [entity["id"] for entity in entities] == [str(mover.number) for mover in movers]
        for entity, mover in zip(entities, movers, strict=True):
            at = pose_of(entity["cylinders"][0]["pose"])[:2, 3]
            np.testing.assert_allclose(at, mover.position)
            assert entity["cylinders"][0]["size"]["x"] == pytest.approx(2 * mover.radius)
            n_movers += 1
    assert n_movers > 5


def test_who_comes_late_sees_the_map_with_the_next_scan(server, corridor):
    show(server, corridor, range(100))
    for k in (100, 101):  # and who comes after that, too
        with Client(server.url) as client:
            client.subscribe(*TOPICS)
            wait_until_subscribed(server, corridor, client, TOPICS)
            show(server, corridor, [k])
            client.wait(last_pose_is(corridor, k))
            assert client.received["/doubts"][-1]["message"] == "no doubts"


def test_several_lasers_have_topics_of_their_own(server, corridor):
    beams, update = corridor.beams[0], corridor.updates[0]
    for sensor in ("/front/scan", 2):
        moved = type(beams)(**(vars(beams) | {"sensor": sensor}))
        server.show(corridor.mapper, moved, update)
    with Client(server.url) as client:
        topics = {f"/{name}_{kind}" for name in ("front/scan", "scan_2") for kind in KINDS}
        client.wait(lambda client: client.topics.keys() >= topics)


@pytest.mark.slow
def test_in_three_dimensions(server):
    """Of a mapper that answers with poses (4, 4), points (N, 3) and voxels."""
    T = np.eye(4)
    T[:3, 3] = 1.0, 2.0, 3.0
    cells = CellProbabilities(np.array([[2, 9, 0], [5, 5, 5]]), np.float32([1.0, 0.2]), 0.0)
    mapper = SimpleNamespace(path=np.stack([np.eye(4), T]), resolution=0.5, cells=cells)
    beams = to_beams(Scan(10**9, points=[[1.0, 0.0, 0.5], [0.0, 2.0, 0.0], [0.0, 0.0, 9.0]]))
    movers = [Mover(4, np.array([5.0, 5.0, 1.0]), np.zeros(3), np.eye(6), 0.3, 1.0)]
    update = Update(T, np.eye(6), np.float32([0.9, 0.1, np.nan]), None, ("slip",), [], movers)
    run = SimpleNamespace(mapper=mapper, beams=[beams], updates=[update])
    topics = {"/map_points", *TOPICS} - {"/map"}
    with Client(server.url) as client:
        client.subscribe("/map_points", *TOPICS)
        wait_until_subscribed(server, run, client, topics)
    last = {topic: messages[-1] for topic, messages in client.received.items()}
    np.testing.assert_allclose(points_of(last["/map_points"])[0], [[1.25, 4.75, 0.25]])
    np.testing.assert_allclose(points_of(last["/scan_static"])[0], [[2.0, 2.0, 3.5]])
    np.testing.assert_allclose(points_of(last["/scan_dynamic"])[0], [[1.0, 4.0, 3.0]])
    np.testing.assert_allclose(pose_of(last["/pose"]["pose"]), T)
    assert "odometry" in last["/doubts"]["message"]
    (transform,) = last["/tf"]["transforms"]  # without odometry
    assert (transform["parent_frame_id"], transform["child_frame_id"]) == ("map", "base")
    (mover,) = last["/movers"]["entities"]
    np.testing.assert_allclose(pose_of(mover["cylinders"][0]["pose"])[:3, 3], [5.0, 5.0, 1.0])
    line = last["/path"]["entities"][0]["lines"][0]["points"]
    assert line[-1] == {"x": 1.0, "y": 2.0, "z": 3.0}


def read(message):
    """A message as its readers see it."""
    schema = message.get_schema()
    return Schemas(schema.data).read(f".{schema.name}", message.encode())


def test_large_maps_are_shown_in_larger_cells(monkeypatch):
    monkeypatch.setattr(foxglove_server, "_MAX_CELLS", 20_000)
    p = np.full((352, 352), np.nan, np.float32)
    p[:32, :32], p[4, 4], p[320, 320] = 0.0, 1.0, 0.3
    message = read(foxglove_server.to_grid(GridMap(p, (-1.0, 2.0, 0.0), 0.1), STAMP))
    corner, edge, percent = grid_of(message)
    np.testing.assert_allclose(corner, [-1.0, 2.0])
    assert edge == pytest.approx(0.3)
    assert percent.size <= 20_000
    assert (percent[1, 1], percent[0, 0], percent[106, 106], percent[50, 50]) == (100, 0, 30, 255)


def test_movers_have_arrows_as_long_as_their_way():
    mover = Mover(7, np.array([1.0, 2.0]), np.array([0.0, 1.5]), np.eye(4), 0.3, 1.0)
    message = read(foxglove_server.to_movers([mover], STAMP))
    (deletion,), (entity,) = message["deletions"], message["entities"]
    assert deletion["type"] == foxglove.messages.SceneEntityDeletionType.All.value
    assert stamp_of(entity) == 1_700_000_000_123_456_789
    body, arrow = entity["cylinders"][0], entity["arrows"][0]
    assert body["size"]["x"] == pytest.approx(0.6)
    assert arrow["shaft_length"] + arrow["head_length"] == pytest.approx(1.5)
    np.testing.assert_allclose(pose_of(arrow["pose"])[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)
    assert entity["id"] == "7"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--foxglove", "--port", "TAKEN"], "in use"),
        (["--foxglove", "--port", "70000"], "port is from 0"),
        (["--foxglove", "--port", "0", "--host", "192.0.2.1"], "192.0.2.1"),
        (["--port", "8765"], "--foxglove"),
    ],
)
def test_calls_that_make_no_sense(server, hall, tmp_path, capsys, words, expected):
    words = [server.url.rpartition(":")[2] if word == "TAKEN" else word for word in words]
    assert main(["live", "--replay", str(hall), "-o", str(tmp_path / "out"), *words]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert expected in said
    assert not (tmp_path / "out").exists()


def test_the_result_is_the_same_as_without(hall, tmp_path, capsys):
    for name, words in (("plain", []), ("seen", ["--foxglove", "--port", "0"])):
        assert main(["live", "--replay", str(hall), "-o", str(tmp_path / name), *words]) == 0
    assert "ws://127.0.0.1:" in capsys.readouterr().err
    for file in ("trajectory.tum", "live/trajectory.tum", "beams/p_static.npy", "map.pgm"):
        assert (tmp_path / "plain" / file).read_bytes() == (tmp_path / "seen" / file).read_bytes()


def test_ctrl_c_ends_it_with_a_whole_result(hall, tmp_path):
    words = ["live", "--replay", hall, "-o", tmp_path / "out", "--rate", "0.5", "--foxglove"]
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)  # a child inherits it when ignored
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", "stillmap", *map(str, words), "--port", "0", "--quiet"],
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
    finally:
        signal.signal(signal.SIGINT, before)
    with process:
        url = re.search(r"ws://\S+?(?=[,\s])", process.stderr.readline())[0]
        with Client(url) as client:
            client.subscribe("/pose", "/map")
            client.wait(lambda client: len(client.received.get("/pose", [])) > 3, 60.0)
            os.killpg(process.pid, signal.SIGINT)  # as a terminal sends it, to the server as well
            client.read_all()
        _, said = process.communicate(timeout=60)
    assert process.returncode == 0, said
    assert "Traceback" not in said
    n = len((tmp_path / "out/trajectory.tum").read_text().splitlines())
    assert 3 <= n < 80
    assert len((tmp_path / "out/live/trajectory.tum").read_text().splitlines()) == n
    assert json.loads((tmp_path / "out/run.json").read_text())
