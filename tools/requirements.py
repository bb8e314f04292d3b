"""Prints requirements of pyproject.toml, one a line: `build`, or those of an extra."""

import re
import sys
import tomllib
from pathlib import Path

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())


def of_extra(name: str) -> list[str]:
    """Requirements of an extra; where it names extras of stillmap itself, theirs."""
    found = []
    for requirement in PROJECT["project"]["optional-dependencies"][name]:
        own = re.fullmatch(r"stillmap\[(.*)\]", requirement)
        found += (
            [r for other in own[1].split(",") for r in of_extra(other)] if own else [requirement]
        )
    return found


if sys.argv[1] == "build":
    # an isolated build fetches these two only where the machine has none
    print("\n".join([*PROJECT["build-system"]["requires"], "cmake", "ninja"]))
else:
    print("\n".join([*PROJECT["project"]["dependencies"], *of_extra(sys.argv[1])]))
