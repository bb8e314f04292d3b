"""Simulated recordings of places where people, doors and cars move, with the truth of each beam."""

from stillmap.sim.appearance import static_colour
from stillmap.sim.options import (
    CameraOptions,
    CrowdOptions,
    DoorOptions,
    GroundOptions,
    HeightOptions,
    LaserOptions,
    LidarOptions,
    OdometryOptions,
    RigOptions,
    RobotOptions,
    TrafficOptions,
)
from stillmap.sim.scene import Door, Lane, Light, Scene, Stay, Thing
from stillmap.sim.simulator import RigSimulation, Simulation, simulate, simulate_rig
from stillmap.sim.truth import Truth, load_truth
from stillmap.sim.truth_images import PictureTruth, load_picture_truth
from stillmap.sim.truth_surfaces import mover_points
from stillmap.sim.worlds import SCENES, scene_by_name
from stillmap.sim.writer import write_rig, write_simulation

__all__ = [
    "SCENES",
    "CameraOptions",
    "CrowdOptions",
    "Door",
    "DoorOptions",
    "GroundOptions",
    "HeightOptions",
    "Lane",
    "LaserOptions",
    "LidarOptions",
    "Light",
    "OdometryOptions",
    "PictureTruth",
    "RigOptions",
    "RigSimulation",
    "RobotOptions",
    "Scene",
    "Simulation",
    "Stay",
    "Thing",
    "TrafficOptions",
    "Truth",
    "load_picture_truth",
    "load_truth",
    "mover_points",
    "scene_by_name",
    "simulate",
    "simulate_rig",
    "static_colour",
    "write_rig",
    "write_simulation",
]
