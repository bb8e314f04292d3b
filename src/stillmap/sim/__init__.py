"""Simulated recordings of places with people, doors and vehicles, with the truth of each beam."""

from stillmap.sim.scene import Scene
from stillmap.sim.simulator import Simulation, simulate, write_simulation
from stillmap.sim.truth import load_truth
from stillmap.sim.worlds import SCENES, scene_by_name

__all__ = [
    "SCENES",
    "Scene",
    "Simulation",
    "load_truth",
    "scene_by_name",
    "simulate",
    "write_simulation",
]
