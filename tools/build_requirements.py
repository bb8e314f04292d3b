"""Prints what an unisolated build needs, one requirement a line, as pyproject.toml has it."""

import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())
# an isolated build fetches these two only where the machine has none
print("\n".join([*project["build-system"]["requires"], "cmake", "ninja"]))
