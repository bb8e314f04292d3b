"""stillmap: clean maps of what stands still, from a robot's recording of a place full of movers.

import stillmap
recording = stillmap.read("log.clf.gz")
result = stillmap.build(recording)
result.save("out")
"""

from importlib.metadata import PackageNotFoundError, version

from stillmap.errors import InputError
from stillmap.pipeline import Iteration, Options, iterate
from stillmap.recording import Recording, read
from stillmap.result import Result, build

try:
    __version__ = version("stillmap")
except PackageNotFoundError:  # run from a source tree that is not installed
    __version__ = "0+unknown"

__all__ = [
    "InputError",
    "Iteration",
    "Options",
    "Recording",
    "Result",
    "__version__",
    "build",
    "iterate",
    "read",
]
