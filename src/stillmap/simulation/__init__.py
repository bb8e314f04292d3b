"""Simulated recordings of places where people, doors and cars move, with the truth of each beam."""

from stillmap.simulation.lidar_options import GroundOptions, HeightOptions, LidarOptions, RigOptions
from stillmap.simulation.options import (
    CrowdOptions,
    DoorOptions,
    LaserOptions,
    OdometryOptions,
    RobotOptions,
    TrafficOptions,
)
from stillmap.simulation.scene import Door, Lane, Light, Scene, Stay, Thing
from stillmap.simulation.simulator import RigSimulation, Simulation, simulate, simulate_rig
from stillmap.simulation.truth import Truth, load_truth
from stillmap.simulation.worlds import SCENES, scene_by_name
from stillmap.simulation.writing import write_rig, write_simulation

__all__ = [
    "SCENES",
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
    "RigOptions",
    "RigSimulation",
    "RobotOptions",
    "Scene",
    "Simulation",
    "Stay",
    "Thing",
    "TrafficOptions",
    "Truth",
    "load_truth",
    "scene_by_name",
    "simulate",
    "simulate_rig",
    "write_rig",
    "write_simulation",
]
