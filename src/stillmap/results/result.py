"""The public result of mapping: what it can do, whether just built or loaded from its folder."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import import_extra
from stillmap.pipeline.result import MappingResult
from stillmap.results.plot import plot_result, summarize_as_html
from stillmap.results.result_data import ResultData
from stillmap.results.run_json import run_record
from stillmap.results.save import save
from stillmap.results.tables import TableName, make_table

if TYPE_CHECKING:
    import pandas
    import pyarrow
    from matplotlib.axes import Axes

    from stillmap.mesh.build import Models


class Result(ResultData):
    """A mapped recording of T scans with M beams in D dimensions.

    `stillmap.build` makes a `BuiltResult`, `stillmap.load` opens a `SavedResult`; both have what
    stands here.
    """

    def plot(
        self, ax: "Axes | None" = None, *, trajectory: bool = True, dynamic: bool = False
    ) -> "Axes":
        """Draw the map with matplotlib, in metres.

        Args:
            ax: axes to draw into; None: new ones.
            trajectory: draw the way of the robot.
            dynamic: draw returns from what moves; a saved result reads its recording for it.

        Returns:
            The axes.

        Raises:
            MissingExtra: matplotlib is not installed.
        """
        return plot_result(self, ax, trajectory=trajectory, dynamic=dynamic)

    def to_arrow(self, table: TableName = "beams") -> "pyarrow.Table":
        """One of the result's tables.

        Args:
            table: "beams" (a row each: scan, stamp_ns, beam, x, y, z, range, hit, p_static),
                "poses" (a row per scan), "objects" (a row per moving object) or "tracks" (a row
                per position of one). Metres in the map frame, metres per second, radians.

        Raises:
            MissingExtra: pyarrow is not installed.
            ValueError: there is no such table.
        """
        return make_table(self, table)

    def to_dataframe(self, table: TableName = "beams") -> "pandas.DataFrame":
        """A table of `to_arrow` as a pandas DataFrame.

        Raises:
            MissingExtra: pandas or pyarrow is not installed.
            ValueError: there is no such table.
        """
        import_extra("pandas", "a DataFrame", "made", group="notebook")
        return self.to_arrow(table).to_pandas()

    def __repr__(self) -> str:
        n, notes = len(self.objects), len(self.warnings)
        return (
            f"<{type(self).__name__}: {len(self.stamp_ns)} scans with {len(self.p_static)} beams, "
            f"{n} moving object{'s' * (n != 1)}, {notes} warning{'s' * (notes != 1)}, {self.map}>"
        )

    def _repr_html_(self) -> str:
        return summarize_as_html(self)


@dataclass(frozen=True, eq=False, repr=False)
class BuiltResult(MappingResult, Result):
    """A recording that was just mapped; further fields are those of `MappingResult`."""

    __repr__ = Result.__repr__

    @property
    def stamp_ns(self) -> NDArray[np.int64]:
        """(T,) stamps of the scans in nanoseconds."""
        return self.recording.stamp_ns

    @property
    def hit(self) -> NDArray[np.bool_]:
        """(M,) whether a beam ended on something."""
        return self.recording.hit

    @property
    def run(self) -> dict[str, Any]:
        """The content of `run.json`, computed at every call."""
        return run_record(self)

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        overwrite: bool = False,
        models: "Models | None" = None,
    ) -> None:
        """Write the result folder, complete or not at all; `stillmap.load` opens it.

        Args:
            path: the folder; must not exist or be empty unless `overwrite`.
            overwrite: replace an earlier result.
            models: the meshes that `build_models` made of this result; None: without.

        Raises:
            InputError: the folder is taken or cannot be written.
        """
        save(self, Path(path), overwrite, models=models)
