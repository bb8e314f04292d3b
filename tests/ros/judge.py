"""The judge reads what the node says, by another DDS library than ROS uses."""

import math

import numpy as np
import ros_idl as idl

from stillmap.core import se2


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
