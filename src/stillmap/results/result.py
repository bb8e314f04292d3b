"""`stillmap.Result`: a mapped place of one session or several, just made or loaded."""

# signatures name ArrayLike instead of spelling it out
from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from stillmap.core import config
from stillmap.core.errors import InputError, import_extra
from stillmap.core.files import atomic_folder
from stillmap.core.input_files import copy_file
from stillmap.core.profiling import Progress, StageTimer, no_progress, show_iterations, show_steps
from stillmap.core.recording import Recording
from stillmap.pipeline import inputs
from stillmap.pipeline.options import DEFAULTS, Options
from stillmap.pipeline.result import map_recording
from stillmap.results.mapped_place import MappedPlace, PathLike, Source
from stillmap.results.plot import plot_result, summarize_as_html
from stillmap.results.reader import RECORD
from stillmap.results.tables import TableName, make_table
from stillmap.results.writer import save

if TYPE_CHECKING:
    import pandas
    import pyarrow
    from matplotlib.axes import Axes

    from stillmap.mesh.build import Models


class Result(MappedPlace):
    """A mapped place: T scans with M beams in D dimensions, of one session or several.

    Of several, poses, stamps and labels are those of the sessions one after the other. One that was
    just built also has the attributes of its `mapping`.

    Attributes:
        map: of what is static: `p_occupied` (H, W), `origin`, `resolution` in m.
        poses: (T, D+1, D+1) T_map_base.
        stamp_ns: (T,) stamps of the scans in nanoseconds.
        p_static: (M,) P(c = 1); NaN: unusable, the prior at maximum range.
        hit: (M,) whether a beam ended on something.
        objects: movers: `id`, `stamp_ns` (L,), `xy`, `velocity` (L, 2), `size`, `p_dynamic`,
            `p_identity`.
        sessions: that were merged, accepted or not, in the order in which they were given.
        changes: what changed between sessions, in the order of time.
        mapping: what was just built, which has more than the folder keeps; None: it was loaded.
        folder: that it was loaded from; None: it was built.
        source: the recording, its path or those of its parts, where it was given; None: as the
            record says.
    """

    def load_session(self, name: str, *, recording: Source | None = None) -> Result:
        """One session as a result, in the frame of the place and with its map.

        Args:
            name: of an accepted session.
            recording: as of `stillmap.load`.

        Raises:
            InputError: there is no such session, or a file of it is missing or damaged.
        """
        known = [one.name for one in self.sessions if one.accepted]
        if name not in known:
            hint = f"there are {', '.join(known)}"
            raise InputError(f"has no session {name}", where=str(self.path), hint=hint)
        if len(known) == 1 or self.path is None:
            return self
        return load(self.path / "sessions" / name, recording=recording)

    def save(
        self, path: PathLike, *, overwrite: bool = False, models: Models | None = None
    ) -> None:
        """Write the folder, complete or not at all; `stillmap.load` opens it.

        Args:
            path: the folder; must not exist or be empty unless `overwrite`.
            overwrite: replace an earlier result.
            models: the meshes that `build_models` made of a result that was just built.

        Raises:
            InputError: the folder is taken or cannot be written, or lies in the result.
        """
        target = Path(path)
        if self.mapping is not None:
            save(self.mapping, target, overwrite, models=models)
            return
        source = self.loaded.folder
        if source.resolve() in (target.resolve(), *target.resolve().parents):
            raise InputError("is the result itself, or inside", where=str(target))
        with atomic_folder(target, RECORD, overwrite) as folder:
            shutil.copytree(source, folder, dirs_exist_ok=True, copy_function=copy_file)

    def plot(
        self,
        ax: Axes | None = None,
        *,
        trajectory: bool = True,
        dynamic: bool = False,
        changes: bool = True,
    ) -> Axes:
        """Draw the map with matplotlib, in metres.

        Args:
            ax: axes to draw into; None: new ones.
            trajectory: draw the way of the robot in each session.
            dynamic: draw returns from what moves; reads recordings for it.
            changes: draw boxes around what changed between sessions.

        Returns:
            The axes.

        Raises:
            MissingExtra: matplotlib is not installed.
        """
        names = [one.name for one in self.sessions if one.accepted] if dynamic else []
        moving = (self.load_session(name) for name in names)  # one in memory at a time
        return plot_result(self, ax, trajectory=trajectory, moving=moving, changes=changes)

    def to_arrow(self, table: TableName = "beams") -> pyarrow.Table:
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

    def to_dataframe(self, table: TableName = "beams") -> pandas.DataFrame:
        """A table of `to_arrow` as a pandas DataFrame.

        Raises:
            MissingExtra: pandas or pyarrow is not installed.
            ValueError: there is no such table.
        """
        import_extra("pandas", "a DataFrame", "made", group="notebook")
        return self.to_arrow(table).to_pandas()

    def __repr__(self) -> str:
        n, notes, m = len(self.objects), len(self.warnings), len(self.changes)
        placed, given = len(self.stretches), len(self.sessions)
        of = f"{placed} of {given} sessions with " if given > 1 else ""
        between = f"{m} change{'s' * (m != 1)} between them, " if given > 1 else ""
        return (
            f"<{type(self).__name__}: {of}{len(self.stamp_ns)} scans with {len(self.p_static)} "
            f"beams, {n} moving object{'s' * (n != 1)}, {between}"
            f"{notes} warning{'s' * (notes != 1)}, {self.map}>"
        )

    def _repr_html_(self) -> str:
        return summarize_as_html(self)


def build(
    recording: Recording | PathLike | Sequence[PathLike],
    options: Options | Mapping[str, Any] | None = None,
    *,
    resolution: float | None = None,
    odometry: bool = True,
    poses: ArrayLike | PathLike | None = None,
    progress: bool | Progress = False,
    scratch: PathLike | None = None,
) -> Result:
    """Map a recording: poses, P(static) of every beam, the map of what is static, what moved.

    Models of a 3D recording are made by `stillmap.build_models`.

    Args:
        recording: a `Recording`, or the path of one in any format that `stillmap.read` reads, or
            the paths of the parts of one run.
        options: `Options`, or the options to change, as in `{"em.prior": 0.8, "threads": 1}`;
            `stillmap config` prints all of them. None: the defaults.
        resolution: metres, edge of a map cell, in 3D of a voxel; None: as the options say.
        odometry: whether the recording's odometry is used.
        poses: poses to keep instead of estimating them: (T, D+1, D+1) T_map_base, in 2D also
            (T, 3) x, y (m), theta (rad); the path of a TUM trajectory; or "recording" for those
            that the recording states.
        progress: show a bar, in notebooks below the cell; or a function that is called with the
            stage, the iteration (0: outside the loop), the work done, and of how much.
        scratch: folder for arrays that are too large for memory; None: the system's temporary one.

    Raises:
        InputError: the recording or the trajectory cannot be read or mapped, or an option is
            unknown or out of range.
        ValueError: a recording without scans, poses of another shape.
        OSError: the disk of `scratch` is full.

    Examples:
        >>> result = stillmap.build("log.bag", resolution=0.1)
        >>> result.save("out")
    """
    chosen = to_options(options)
    if resolution is not None:
        edge = float(resolution)
        chosen = config.override(chosen, {"slam": {"resolution": edge, "voxel_size": edge}})
    stages, folder = StageTimer(), None if scratch is None else Path(scratch)
    with report_to(progress, chosen.em.max_iterations) as report:
        if not isinstance(recording, Recording):
            with stages.measure("read"):
                recording = inputs.read(
                    recording, chosen.read, progress=_percent(report), scratch=folder
                )
        elif not recording.n_scans:
            raise ValueError("recording: expected at least one scan")
        if not odometry:
            recording = recording.without_odometry()
        kept = inputs.read_poses(poses, recording)
        inputs.require_mappable(recording, chosen, kept)
        mapping = map_recording(
            recording, chosen, poses=kept, progress=report, stages=stages, scratch=folder
        )
        return Result.of(mapping)


def load(path: PathLike, *, recording: Source | None = None) -> Result:
    """Open a folder that `stillmap map`, `stillmap merge` or `save` wrote.

    Args:
        path: the folder of a result or of a place, or `sessions/NAME` in one.
        recording: what was mapped, or where it lies now, all parts in order of time; None: where
            it was then. It is read when it is first used, say for `deskewed` or the table of beams.

    Raises:
        InputError: there is no result, or a file of it is missing or damaged.

    Examples:
        >>> result = stillmap.load("out")
        >>> result.plot()
    """
    return Result.open(path, recording)


def to_options(options: Options | Mapping[str, Any] | None) -> Options:
    """The options that a caller gave: all of them, those to change, or none.

    Raises:
        InputError: there is no such option, or a value is out of range.
    """
    if options is None:
        return DEFAULTS
    if isinstance(options, Options):
        return options
    if isinstance(options, Mapping):
        return config.override(DEFAULTS, config.nest(options))
    raise TypeError(f"options: expected Options or a mapping, got {type(options).__name__}")


@contextmanager
def report_to(progress: bool | Progress, iterations: int) -> Iterator[Progress]:
    """The callback that was given as `progress`, a bar, or nothing."""
    if callable(progress):
        yield progress
    elif progress:
        with show_steps() as show:
            yield show_iterations(show, iterations)
    else:
        yield no_progress


def _percent(report: Progress) -> Any:
    """Progress of reading, as a share, reported in percent."""
    return lambda share: report("reading", 0, round(100.0 * share), 100)
