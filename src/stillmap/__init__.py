"""stillmap: clean maps of what stands still, from a robot's recording of a place full of movers.

import stillmap
recording = stillmap.read("log.clf.gz")
result = stillmap.build(recording)
result.save("out")
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stillmap.core.errors import InputError, MissingExtra
    from stillmap.core.recording import Recording
    from stillmap.live.mapper import LiveMapper
    from stillmap.live.scan import Scan
    from stillmap.live.update import Update
    from stillmap.mesh.build import Models
    from stillmap.pipeline.em_loop import Iteration, iterate
    from stillmap.pipeline.inputs import read
    from stillmap.pipeline.options import Options
    from stillmap.places.merge import merge
    from stillmap.prepare.options import ReadOptions
    from stillmap.results.models import build_models
    from stillmap.results.result import Result, build, load
    from stillmap.results.timeline import PlaceSession, SessionChange

    __version__: str

__all__ = [
    "InputError",
    "Iteration",
    "LiveMapper",
    "MissingExtra",
    "Models",
    "Options",
    "PlaceSession",
    "ReadOptions",
    "Recording",
    "Result",
    "Scan",
    "SessionChange",
    "Update",
    "__version__",
    "build",
    "build_models",
    "iterate",
    "load",
    "merge",
    "read",
]

# loaded when they are first used: `stillmap --help` has no use for them, and they take long
_MODULES = {
    "InputError": "core.errors",
    "Iteration": "pipeline.em_loop",
    "LiveMapper": "live.mapper",
    "MissingExtra": "core.errors",
    "Models": "mesh.build",
    "Options": "pipeline.options",
    "PlaceSession": "results.timeline",
    "ReadOptions": "prepare.options",
    "Recording": "io",
    "Result": "results.result",
    "Scan": "live.scan",
    "SessionChange": "results.timeline",
    "Update": "live.update",
    "build": "results.result",
    "build_models": "results.models",
    "iterate": "pipeline.em_loop",
    "load": "results.result",
    "merge": "places.merge",
    "read": "pipeline.inputs",
}
_ROOMS = (
    "core",
    "em",
    "io",
    "live",
    "mapping",
    "mesh",
    "pipeline",
    "places",
    "prepare",
    "results",
    "sim",
    "slam",
    "tracking",
)


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    elif name == "__version__":
        from stillmap.core.files import package_version

        value = package_version()
    elif name in _ROOMS:
        return importlib.import_module(f"{__name__}.{name}")
    else:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_ROOMS})
