"""The ROS 2 node: from the message of a scan to the message of its pose, through DDS.

build/ros/jazzy/bin/python benchmarks/live_ros.py [--world hall] [--seconds 60] [--rate 40]

in the environment of `make test-ros`. The robot sends a simulated recording at its own speed in a
process of its own; scans, odometry and transforms pass as in tests/ros. A scan's time is from just
before it is sent until its pose has arrived in this process.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np

from stillmap.io.stillmap_folder import write
from stillmap.sim import scene_by_name, simulate

_TESTS = Path(__file__).resolve().parents[1] / "tests/ros"
_START, _REST = 30.0, 10.0  # s that all have to find each other, and for the last answers


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--world", default="hall")
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--seconds", type=float, default=60.0)
    p.add_argument("--rate", type=float, default=40.0)
    p.add_argument("--beams", type=int, default=1081)
    p.add_argument("--domain", type=int, default=20 + os.getpid() % 80)
    args = p.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        print(measure(args, Path(folder)), flush=True)


def measure(args: argparse.Namespace, folder: Path) -> str:
    """One line about the times."""
    sys.path.insert(0, str(_TESTS))
    import ros_idl as idl
    from dds import Participant, wait_for

    laser = {"beams": args.beams, "fov": math.radians(270)}
    robot = {"scans": round(args.seconds * args.rate), "scan_rate": args.rate}
    scene = scene_by_name(args.world, {"laser": laser, "robot": robot})
    recording = simulate(scene, args.seed).recording
    write(recording, folder / "recording")
    judge = Participant(args.domain)
    poses = judge.read(idl.PoseWithCovarianceStamped, "pose", depth=1000, reliable=True)
    log = folder / "sent.jsonl"
    domain, period = str(args.domain), str(1.0 / args.rate)
    with (
        _Child(args.domain, "-m", "stillmap", "live", "-o", str(folder / "out"), "--threads", "1"),
        _Child(
            *(args.domain, str(_TESTS / "robot.py"), str(folder / "recording"), "--tf"),
            *("--domain", domain, "--log", str(log), "--period", period),
        ),
    ):
        wait_for(lambda: len(poses) == recording.n_scans, _START + args.seconds + _REST)
    judge.close()
    return describe([json.loads(line) for line in log.read_text().splitlines()], poses)


def describe(sent: list[dict[str, float]], poses: list) -> str:
    at = {line["stamp_ns"]: line["sent"] for line in sent}
    stamps = [p.message.header.stamp for p in poses]
    ms = [
        1e3 * (pose.at - at[stamp.sec * 10**9 + stamp.nanosec])
        for pose, stamp in zip(poses, stamps, strict=True)
    ]
    median, p99, most = np.quantile(ms, (0.5, 0.99, 1.0))
    load = os.getloadavg()[0]
    return (
        f"{len(sent)} scans sent, {len(ms)} answered: median {median:.1f} ms, 99 % {p99:.1f} ms, "
        f"at most {most:.1f} ms; load of {os.cpu_count()} cores at the end: {load:.1f}"
    )


class _Child:
    """A Python process that is killed at the end of a with block: nothing is to be saved."""

    def __init__(self, domain: int, *words: str) -> None:
        folder = Path(sys.prefix) / "messages/lib"
        version = f"python{sys.version_info.major}.{sys.version_info.minor}"
        environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "OPENBLAS_NUM_THREADS": "1",
        }
        for name, path in (
            ("PYTHONPATH", folder / version / "site-packages"),
            ("LD_LIBRARY_PATH", folder),
        ):
            known = filter(None, [os.environ.get(name)])
            environment[name] = os.pathsep.join([str(path), *known])
        self._process = subprocess.Popen([sys.executable, *words], env=environment)

    def __enter__(self) -> "_Child":
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(0.0)
        self._process.kill()
        self._process.wait()


if __name__ == "__main__":
    main()
