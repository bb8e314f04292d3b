"""Simulated recordings of places with people, doors and vehicles, with the truth of each beam."""

from stillmap.sim.scene import Scene as Scene
from stillmap.sim.simulator import Simulation as Simulation
from stillmap.sim.simulator import simulate as simulate
from stillmap.sim.simulator import write_simulation as write_simulation
from stillmap.sim.truth import load_truth as load_truth
from stillmap.sim.worlds import SCENES as SCENES
from stillmap.sim.worlds import scene_by_name as scene_by_name
