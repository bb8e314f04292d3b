"""Models of a result, as `stillmap map` makes them."""

from stillmap.core.parallel import limit_blas_threads, resolve_threads
from stillmap.core.profiling import StageTimer
from stillmap.mesh import build
from stillmap.mesh.build import Models
from stillmap.mesh.inputs import sources_of, sources_of_rig
from stillmap.pipeline.em_loop import Progress, silent
from stillmap.pipeline.result import Result
from stillmap.rig.build import TiltingResult


@limit_blas_threads()
def models_of(
    result: Result,
    *,
    tilting: TiltingResult | None = None,
    progress: Progress = silent,
    stages: StageTimer | None = None,
) -> Models:
    """The surface of the place, painted, and models of what moved; `result.save` writes them.

    Args:
        result: of a recording in 3D; its options `mesh` say how.
        tilting: what a second laser built in 3D; then the result is of one that lies flat.
        progress: called with what is done, 0, and how much of it.
        stages: where time and memory per stage are noted.

    Raises:
        ValueError: nothing is in 3D.
        MissingExtra: a library of the extra `mesh` is not installed.
    """
    if tilting is None and result.recording.dimension == 2:
        raise ValueError("result: expected one in 3D")
    build.require_extras()
    sources = sources_of(result) if tilting is None else sources_of_rig(result, tilting)
    options, threads = result.options.mesh, resolve_threads(result.options.threads)
    return build.build_models(sources, options, threads, progress, stages)
