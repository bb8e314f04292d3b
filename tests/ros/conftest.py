"""A robot, the node and a judge, each in a process of its own; `make test-ros` runs these tests."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))  # for what the tests share
# it is ignored where a shell runs the tests in the background, and nodes would ignore it, too
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def domain():
    """A ROS domain that other runs on this machine do not use (nor those of other people)."""
    return 20 + os.getpid() % 80


@pytest.fixture(scope="session")
def environment(domain, tmp_path_factory):
    """Of all processes: this machine alone, one thread of BLAS."""
    return {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(tmp_path_factory.mktemp("log")),
        "OPENBLAS_NUM_THREADS": "1",
    }


@pytest.fixture(scope="session")
def tf_environment(environment):
    """The same, with tf2_msgs and map_msgs, which were built, and a part of tf2_ros, which lies
    here: the package index has none of them."""
    folder = Path(sys.prefix) / "messages"
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    if not folder.is_dir():
        pytest.skip(f"no messages in {folder}: tools/ros_environment.sh builds it")

    def extend(name, path):
        return os.pathsep.join([str(path), *filter(None, [environment.get(name)])])

    return {
        **environment,
        "PYTHONPATH": extend("PYTHONPATH", f"{folder / 'lib' / version / 'site-packages'}:{HERE}"),
        "LD_LIBRARY_PATH": extend("LD_LIBRARY_PATH", folder / "lib"),
    }


@pytest.fixture(scope="session")
def simulation():
    from stillmap.sim import scene_by_name, simulate

    return simulate(scene_by_name("corridor", {"robot": {"scans": 400}}), 3)


@pytest.fixture(scope="session")
def recording(simulation, tmp_path_factory):
    """The folder of the recording that the robot sends."""
    from stillmap.io.stillmap_folder import write

    path = tmp_path_factory.mktemp("robot") / "recording"
    write(simulation.recording, path)
    return path


@pytest.fixture(scope="session")
def sweeps(tmp_path_factory):
    """Sweeps of a lidar in a street: the simulation, and the folder of its recording."""
    from stillmap.io.stillmap_folder import write
    from stillmap.sim import scene_by_name, simulate

    changes = {"lidar": {"channels": 16, "columns": 360}, "robot": {"scans": 60}}
    simulation = simulate(scene_by_name("street", changes), 1)
    path = tmp_path_factory.mktemp("lidar") / "recording"
    write(simulation.recording, path)
    return simulation, path


class Process:
    """A child process with its output in a file."""

    def __init__(self, words, environment, output):
        self.output = output
        with output.open("w") as stream:
            self._process = subprocess.Popen(
                [sys.executable, *map(str, words)], env=environment, stdout=stream, stderr=stream
            )

    @property
    def text(self):
        return self.output.read_text()

    @property
    def is_running(self):
        return self._process.poll() is None

    def send(self, number):
        self._process.send_signal(number)

    def wait(self, timeout=60.0):
        return self._process.wait(timeout)

    def kill(self):
        if self.is_running:
            self.send(signal.SIGKILL)
            self.wait()


@pytest.fixture
def start(tmp_path):
    """Starts processes, which are killed after the test."""
    running = []

    def run(words, environment):
        running.append(Process(words, environment, tmp_path / f"process-{len(running)}.log"))
        return running[-1]

    yield run
    for process in running:
        process.kill()


@pytest.fixture
def start_node(start, tmp_path):
    """Starts nodes of which each writes `result` when it ends."""

    def run(environment, *parameters, more=()):
        flags = [word for one in parameters for word in ("-p", one)]
        words = ["-m", "stillmap", "live", "-o", tmp_path / "result", "--overwrite", "--quiet"]
        return start([*words, *more, "--threads", "1", "--ros-args", *flags], environment)

    return run


@pytest.fixture
def start_robot(start, environment, domain, recording, tmp_path):
    """Starts robots; the second value reads when they sent which stamps."""

    def run(*flags, recording=recording):
        log = tmp_path / "robot.jsonl"
        words = [HERE / "robot.py", recording, "--domain", domain, "--log", log, *flags]
        robot = start(words, environment)
        return robot, lambda: [json.loads(line) for line in log.read_text().splitlines()]

    return run


@pytest.fixture
def participant(domain):
    """The judge's in DDS."""
    from dds import Participant

    made = Participant(domain)
    yield made
    made.close()


@pytest.fixture
def judge(participant):
    """What it hears."""
    from judge import Judge

    return Judge(participant)
