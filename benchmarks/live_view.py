"""CPU time per scan of live mapping without --foxglove, with it, and with a client.

python benchmarks/live_view.py [--world hall] [--seconds 40] [--rate 40] [--beams 1081]

Scans are pushed when they are due. `push` and `show` are CPU times of the thread that maps, `all`
is that of its process, with the threads that send; the server is a process of its own. The client
reads everything that there is.
"""

import argparse
import math
import resource
import subprocess
import sys
import time
from contextlib import contextmanager, nullcontext

import numpy as np
from stillmap.live.foxglove.server import FoxgloveServer

from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.sim import scene_by_name, simulate

_CLIENT = """
import json, sys, websockets.sync.client
with websockets.sync.client.connect(
    sys.argv[1], subprotocols=["foxglove.sdk.v1"], max_size=None
) as socket:
    for message in socket:
        if isinstance(message, str) and (told := json.loads(message))["op"] == "advertise":
            wanted = [{"id": one["id"], "channelId": one["id"]} for one in told["channels"]]
            socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
"""


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--world", default="hall")
    p.add_argument("--seed", type=int, default=5)
    p.add_argument("--seconds", type=float, default=40.0)
    p.add_argument("--rate", type=float, default=40.0)
    p.add_argument("--beams", type=int, default=1081)
    args = p.parse_args()
    laser = {"beams": args.beams, "fov": math.radians(270)}
    robot = {"scans": round(args.seconds * args.rate), "scan_rate": args.rate}
    scene = scene_by_name(args.world, {"laser": laser, "robot": robot})
    recording = simulate(scene, args.seed).recording
    print("| | push | show | all | server | median | 99 % | show at most, ms |")
    for name, is_served, is_watched in (
        ("without", False, False),
        ("nobody looks", True, False),
        ("a client", True, True),
    ):
        before = _children()
        with (
            FoxgloveServer(port=0) if is_served else nullcontext() as server,
            _client(server.url) if is_watched else nullcontext(),
        ):
            row, wall = measure(recording, args.rate, server)
        served = 1e3 * (_children() - before) / recording.n_scans if is_served else 0.0
        cells = [*row[:3], served, *row[3:], wall]
        print(f"| {name} | " + " | ".join(f"{cell:.2f}" for cell in cells) + " |", flush=True)


def measure(recording, rate, server):
    """CPU times per scan (push, show, all), latencies (median, 99 %), longest show; ms."""
    cpu, shown, late, longest = 0.0, 0.0, [], 0.0
    with LiveMapper({"threads": 1}) as mapper:
        whole, begin = time.process_time(), time.perf_counter()
        for t, beams in enumerate(iter_beams(recording)):
            due = begin + t / rate
            time.sleep(max(due - time.perf_counter(), 0.0))
            start = time.thread_time()
            update = mapper.push(beams, recording.T_odom_base[t])
            late.append(time.perf_counter() - due)
            middle, wall = time.thread_time(), time.perf_counter()
            if server is not None:
                server.show(mapper, beams, update)
            longest = max(longest, time.perf_counter() - wall)
            cpu, shown = cpu + middle - start, shown + time.thread_time() - middle
        whole = time.process_time() - whole
    per_scan = 1e3 * np.array([cpu, shown, whole]) / recording.n_scans
    return [*per_scan, *(1e3 * np.quantile(late, [0.5, 0.99]))], 1e3 * longest


@contextmanager
def _client(url):
    process = subprocess.Popen([sys.executable, "-c", _CLIENT, url], stderr=subprocess.DEVNULL)
    time.sleep(2.0)
    try:
        yield
    finally:
        process.kill()  # not reaped here: its time is not the server's


def _children() -> float:
    """CPU seconds of the processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
