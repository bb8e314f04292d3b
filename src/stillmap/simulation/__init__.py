"""Simulated recordings of places where people, doors and cars move, with the truth of each beam."""

from stillmap.simulation.camera_options import CameraOptions
from stillmap.simulation.colours import static_colour
from stillmap.simulation.lidar_options import GroundOptions, HeightOptions, LidarOptions, RigOptions
from stillmap.simulation.moving_surfaces import mover_points
from stillmap.simulation.options import (
    CrowdOptions,
    DoorOptions,
    LaserOptions,
    OdometryOptions,
    RobotOptions,
    TrafficOptions,
)
from stillmap.simulation.picture_truth import PictureTruth, load_picture_truth
from stillmap.simulation.scene import Door, Lane, Light, Scene, Stay, Thing
from stillmap.simulation.simulator import RigSimulation, Simulation, simulate, simulate_rig
from stillmap.simulation.truth import Truth, load_truth
from stillmap.simulation.worlds import SCENES, scene_by_name
from stillmap.simulation.writing import write_rig, write_simulation

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
