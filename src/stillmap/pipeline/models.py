"""Models of a result, as `stillmap map` makes them."""

from stillmap.core.parallel import one_blas_thread, resolved_threads
from stillmap.core.profiling import Stages
from stillmap.mesh import build
from stillmap.mesh.build import Models
from stillmap.mesh.inputs import sources_of, sources_of_rig
from stillmap.pipeline.em_loop import Progress, silent
from stillmap.pipeline.result import Result
from stillmap.rig.build import Tilting


@one_blas_thread()
def models_of(
    result: Result,
    *,
    tilting: Tilting | None = None,
    progress: Progress = silent,
    stages: Stages | None = None,
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
    options, threads = result.options.mesh, resolved_threads(result.options.threads)
    return build.models_of(sources, options, threads, progress, stages)
