"""stillmap: clean maps of what stands still, from a robot's recording of a place full of movers.

import stillmap
recording = stillmap.read("log.clf.gz")
result = stillmap.build(recording)
result.save("out")
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stillmap.core.errors import InputError
    from stillmap.core.recording import Recording
    from stillmap.io import read
    from stillmap.mesh.build import Models
    from stillmap.pipeline.em_loop import iterate
    from stillmap.pipeline.estimate import Iteration
    from stillmap.pipeline.models import build_models
    from stillmap.pipeline.options import Options
    from stillmap.results.result import Result, build

    __version__: str

__all__ = [
    "InputError",
    "Iteration",
    "Models",
    "Options",
    "Recording",
    "Result",
    "__version__",
    "build",
    "build_models",
    "iterate",
    "read",
]

# loaded when they are first used: `stillmap --help` has no use for them, and they take long
_MODULES = {
    "InputError": "core.errors",
    "Iteration": "pipeline.estimate",
    "Models": "mesh.build",
    "Options": "pipeline.options",
    "Recording": "core.recording",
    "Result": "results.result",
    "build": "results.result",
    "iterate": "pipeline.em_loop",
    "build_models": "pipeline.models",
    "read": "io",
}
_ROOMS = (
    "core",
    "em",
    "eval",
    "io",
    "mapping",
    "mesh",
    "pipeline",
    "preprocessing",
    "results",
    "rig",
    "sim",
    "slam",
    "tracking",
    "viewer",
)


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    elif name == "__version__":
        from stillmap.core.version import package_version

        value = package_version()
    elif name in _ROOMS:
        return importlib.import_module(f"{__name__}.{name}")
    else:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_ROOMS})
