"""Clouds that do not say where their sensor was: single files, or folders of them."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from stillmap.recording.clouds.assembling import Cloud, Known, Source, assembled
from stillmap.recording.clouds.files import files_in, stamps_in, stem_of
from stillmap.recording.clouds.origin import Origin
from stillmap.recording.lines import Progress
from stillmap.recording.model import Recording
from stillmap.recording.options import ReadOptions

Reader = Callable[[Path, Origin, Path | None], Cloud]


def surveyed(
    path: Path,
    name: str,
    endings: tuple[str, ...],
    cloud: Reader,
    options: ReadOptions,
    progress: Progress | None,
    scratch: Path | None,
) -> Recording:
    """The recording of a file, or of a folder of them.

    Args:
        path: of the file or folder.
        name: of the format.
        endings: of the names of such files.
        cloud: reads one, of a path, the common origin and a folder for what is large.
        options, progress, scratch: see `assembled`.

    Raises:
        InputError: no cloud can be read.
    """
    files = [path] if path.is_file() else files_in(path, endings)
    stamps = stamps_in([stem_of(file.name, endings) for file in files])
    origin = Origin()
    known = Known(path, name, [], single=path.is_file())
    sources = [
        Source(file.name, partial(cloud, file, origin, scratch), stamps[i] if stamps else None)
        for i, file in enumerate(files)
    ]
    recording = assembled(sources, known, options, progress, scratch)
    recording.source.update(origin.notes())
    recording.source["warnings"] += origin.warnings()
    return recording
