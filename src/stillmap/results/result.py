"""The public result: a mapped recording that can be saved."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stillmap.core.profiling import Progress, StageTimer, no_progress
from stillmap.core.recording import Recording
from stillmap.pipeline.estimate import EmState
from stillmap.pipeline.options import DEFAULTS, Options
from stillmap.pipeline.result import MappingResult, map_recording
from stillmap.results.save import save

if TYPE_CHECKING:
    from stillmap.mesh.build import Models


@dataclass(frozen=True, eq=False)
class Result(MappingResult):
    """A mapped recording; the fields are those of `MappingResult`."""

    def save(
        self, path: str | Path, *, overwrite: bool = False, models: "Models | None" = None
    ) -> None:
        """Writes the result folder, complete or not at all.

        Args:
            path: the folder; must not exist or be empty unless `overwrite`.
            overwrite: replace an earlier result.
            models: the meshes that `build_models` made of this result; None: without.

        Raises:
            InputError: the folder is taken or cannot be written.
        """
        save(self, Path(path), overwrite, models=models)


def build(
    recording: Recording,
    options: Options = DEFAULTS,
    *,
    poses: NDArray[np.float64] | None = None,
    progress: Progress = no_progress,
    stages: StageTimer | None = None,
    scratch: Path | None = None,
    resume: EmState | None = None,
    checkpoint: Callable[[EmState], None] | None = None,
) -> Result:
    """Maps a recording; arguments and errors are those of `map_recording`."""
    result = map_recording(
        recording,
        options,
        poses=poses,
        progress=progress,
        stages=stages,
        scratch=scratch,
        resume=resume,
        checkpoint=checkpoint,
    )
    return Result(**vars(result))
