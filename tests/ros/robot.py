"""A robot: publishes a recording as LaserScan or PointCloud2, and Odometry messages, in a process
of its own."""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import ros_idl as idl
from dds import Participant, wait_for
from scipy.spatial.transform import Rotation

from stillmap.core import se2
from stillmap.io.stillmap_folder import read


def to_stamp(ns):
    return idl.Time(*divmod(int(ns), 10**9))


def to_pose(T):
    if len(T) == 4:
        q = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        return idl.Pose(idl.Point(*T[:3, 3].tolist()), idl.Quaternion(*q))
    x, y, theta = se2.parameters(T).tolist()
    turn = idl.Quaternion(z=float(np.sin(theta / 2)), w=float(np.cos(theta / 2)))
    return idl.Pose(idl.Point(x, y, 0.0), turn)


def to_scan(recording, t, stamp, part=slice(None)):
    """The scan, or a part of its beams."""
    beams = np.arange(recording.offset[t], recording.offset[t + 1])[part]
    points, hit = recording.points[beams], recording.hit[beams]
    length = np.linalg.norm(points, axis=1)
    sensor = recording.source.sensors[0]
    step = sensor.angle_step
    start = sensor.start_angle + step * (part.start or 0)
    return idl.LaserScan(
        header=idl.Header(to_stamp(stamp), "laser"),
        angle_min=start,
        angle_max=start + step * (len(length) - 1),
        angle_increment=step,
        range_max=float(np.nanmax(length[~hit], initial=30.0)),
        ranges=np.where(hit, length, np.inf).tolist(),
    )


def to_cloud(recording, t, stamp):
    """The sweep, with times of its points."""
    beams = recording.beams_of(t)
    points = np.where(recording.hit[beams, None], recording.points[beams], np.nan)
    rows = np.column_stack([points, recording.beam_time[beams]]).astype("<f4")
    fields = [idl.PointField(name, 4 * k, 7, 1) for k, name in enumerate("xyzt")]
    header = idl.Header(to_stamp(stamp), "laser")
    data = list(rows.tobytes())
    return idl.PointCloud2(header, 1, len(rows), fields, False, 16, len(data), data, False)


def make_transform(parent, child, stamp, T):
    pose = to_pose(T)
    p = pose.position
    return idl.TransformStamped(
        idl.Header(to_stamp(stamp), parent),
        child,
        idl.Transform(idl.Vector3(p.x, p.y, p.z), pose.orientation),
    )


def plan(n, lose, swap, seed):
    """Numbers of scans in the order in which they are sent; some are lost, some change places."""
    rng = np.random.default_rng(seed)
    order = list(range(n))
    for k in np.flatnonzero(rng.random(n - 1) < swap):
        order[k], order[k + 1] = order[k + 1], order[k]
    return [t for t in order if rng.random() >= lose]


def main():
    p = argparse.ArgumentParser()
    p.add_argument("recording", type=Path)
    p.add_argument("--domain", type=int, required=True)
    p.add_argument("--log", required=True, help="stamps and when each scan was sent, as JSON lines")
    p.add_argument("--period", type=float, default=0.02, help="s between two scans")
    p.add_argument("--first", type=int, default=0)
    p.add_argument("--last", type=int)
    p.add_argument("--lose", type=float, default=0.0)
    p.add_argument("--swap", type=float, default=0.0)
    p.add_argument("--jump", type=int, default=[], action="append", help="scan with an old stamp")
    p.add_argument("--leap", type=int, default=[], action="append", help="scan far in the future")
    p.add_argument("--shift", type=float, default=0.0, help="s that all stamps are later")
    p.add_argument("--split", action="store_true", help="as two lasers: scan_right, scan_left")
    p.add_argument("--tf", action="store_true", help="odometry and mount on /tf and /tf_static")
    args = p.parse_args()
    recording = read(args.recording)
    robot = Participant(args.domain)
    parts = {"scan": slice(None)}
    if args.split:
        parts = {"scan_right": slice(0, 90), "scan_left": slice(90, None)}
    if recording.dimension == 3:
        parts = {"points": None}
    kind = idl.LaserScan if recording.dimension == 2 else idl.PointCloud2
    scans = {topic: robot.write(kind, topic) for topic in parts}
    odometry = robot.write(idl.Odometry, "odom", reliable=True)
    tf = robot.write(idl.TFMessage, "tf", reliable=True) if args.tf else None
    if args.tf:
        static = robot.write(idl.TFMessage, "tf_static", depth=1, reliable=True, latched=True)
        mount = make_transform("base_footprint", "laser", 0, recording.T_base_sensor[0])
        static.write(idl.TFMessage([mount]))
    for writer in scans.values():
        assert wait_for(lambda w=writer: w.get_publication_matched_status().current_count, 30.0)
    T = recording.T_odom_base
    stamps = recording.stamp_ns + round(1e9 * args.shift)

    def send_odometry(stamp, pose):
        if args.tf:
            tf.write(idl.TFMessage([make_transform("odom", "base_footprint", stamp, pose)]))
        else:
            header = idl.Header(to_stamp(stamp), "odom")
            pose = idl.PoseWithCovariance(to_pose(pose))
            odometry.write(idl.Odometry(header, "base_footprint", pose))

    for k in range(20, 0, -1):  # it stands for a second, until the others have found it too
        send_odometry(stamps[args.first] - k * 50_000_000, T[args.first])
        time.sleep(0.05)
    due = time.monotonic()
    with open(args.log, "w", buffering=1) as log:
        for t in plan(args.last or recording.n_scans, args.lose, args.swap, 1):
            if t < args.first:
                continue
            due += args.period
            time.sleep(max(due - time.monotonic(), 0.0))
            stamp = int(stamps[t])
            stamp += -3_000_000_000 if t in args.jump else 0
            stamp += 3_600_000_000_000 if t in args.leap else 0
            if recording.dimension == 3:
                messages = {"points": to_cloud(recording, t, stamp)}
            else:
                messages = {k: to_scan(recording, t, stamp, part) for k, part in parts.items()}
            sent = time.monotonic()
            for name, message in messages.items():
                scans[name].write(message)
            send_odometry(stamps[t], T[t])
            log.write(json.dumps({"scan": t, "stamp_ns": stamp, "sent": sent}) + "\n")
    time.sleep(0.5)  # what is on its way


if __name__ == "__main__":
    main()
