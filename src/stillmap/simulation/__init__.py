"""Simulated recordings of places full of people, with the truth about every beam."""

from stillmap.simulation.scene import (
    CrowdOptions,
    LaserOptions,
    OdometryOptions,
    RobotOptions,
    Scene,
)
from stillmap.simulation.simulator import Simulation, simulate
from stillmap.simulation.truth import Truth, load_truth
from stillmap.simulation.worlds import SCENES, scene_by_name
from stillmap.simulation.writing import write_simulation

__all__ = [
    "SCENES",
    "CrowdOptions",
    "LaserOptions",
    "OdometryOptions",
    "RobotOptions",
    "Scene",
    "Simulation",
    "Truth",
    "load_truth",
    "scene_by_name",
    "simulate",
    "write_simulation",
]
