"""Simulated recordings of places with people, doors and vehicles, with the truth of each beam."""

from stillmap.sim.camera import compute_static_color
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
from stillmap.sim.truth import ImageTruth, Truth, load_image_truth, load_truth
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
    "ImageTruth",
    "Lane",
    "LaserOptions",
    "LidarOptions",
    "Light",
    "OdometryOptions",
    "RigOptions",
    "RigSimulation",
    "RobotOptions",
    "Scene",
    "Simulation",
    "Stay",
    "Thing",
    "TrafficOptions",
    "Truth",
    "compute_static_color",
    "load_image_truth",
    "load_truth",
    "scene_by_name",
    "simulate",
    "simulate_rig",
    "write_rig",
    "write_simulation",
]
