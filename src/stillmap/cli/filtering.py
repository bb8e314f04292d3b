"""What `stillmap filter` does once it is known what is wanted."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.cli.results import Mapped, found, require_apart
from stillmap.errors import InputError
from stillmap.output.atomic import require_new, require_new_file
from stillmap.recording import Recording, carmen_blanked, folder, spool, writers
from stillmap.recording.formats import format_of
from stillmap.recording.ros.kinds import own_form


class Filtered(NamedTuple):
    """What was written.

    Attributes:
        source: the recording that it was made from.
        hits: beams of it that hit something.
        blanked: of these.
        left_out: scans that are not in it.
        topics: of a bag, that are not in it.
        unfiltered: of a bag, with scans of other lasers, as they were.
    """

    source: Path
    hits: int
    blanked: int
    left_out: int
    topics: list[str]
    unfiltered: list[str]


def filtered(
    result: Path, output: Path, given: str | None, below: float, overwrite: bool
) -> Filtered:
    """Write the recording of a result without the beams that are static with less than `below`.

    Raises:
        InputError: the result or its recording is not there, or the output is taken.
    """
    mapped = found(result, given)
    form = format_of(mapped.source) if mapped.source.exists() else None
    if form is not None:
        _require_ending(output, mapped.source, form.name)
    require_apart(output, mapped.source, mapped.folder)
    in_folder = mapped.source.is_dir() or mapped.source.name == folder.HEADER
    if in_folder:
        mark = "metadata.yaml" if form is not None and form.name == "ROS bag" else folder.HEADER
        require_new(output, mark, overwrite)
    else:
        require_new_file(output, overwrite)
    recording, labels = mapped.read()
    hits = blanked = 0
    scratch = output.absolute().parent
    blank = spool.empty(recording.hit.shape, np.bool_, scratch)
    for block in spool.blocks(recording.hit, labels.p_static, blank):
        hit = recording.hit[block]
        # NaN: unusable anyway
        blank[block] = hit & (labels.p_static[block] < below)
        hits += int(np.count_nonzero(hit))
        blanked += int(np.count_nonzero(blank[block]))
    written = _write(mapped, output, recording, blank, overwrite)
    return Filtered(mapped.source, hits, blanked, *written)


def _require_ending(output: Path, source: Path, form: str) -> None:
    """What is written has the form of the source: no other one is to be named.

    Raises:
        InputError: the ending is that of another form.
    """
    own = {"CARMEN log": "carmen", "ROS bag": ""}.get(form, form)
    said = writers.said_by_ending(output)
    if said is not None and said != (own or own_form(source)[0]):
        what = f"would be a {form} like {source.name}, which its ending does not say"
        raise InputError(what, where=str(output), hint="`stillmap convert` makes another form")


def _write(
    mapped: Mapped, output: Path, recording: Recording, blank: NDArray[np.bool_], overwrite: bool
) -> tuple[int, list[str], list[str]]:
    """How many scans, and which topics, are not in what was written; which are not filtered."""
    form = format_of(mapped.source)
    if form.name == "ROS bag":
        from stillmap.recording.ros import blanked

        options = mapped.read_options
        done = blanked.write(mapped.source, output, recording, blank, options, overwrite=overwrite)
        return done.left_out, done.topics, done.unfiltered
    if form.name == "stillmap recording":
        folder.write(
            _without(recording, blank, output.absolute().parent), output, overwrite=overwrite
        )
        return 0, [], []
    if form.name == "CARMEN log":
        return carmen_blanked.write(mapped.source, output, recording, blank).left_out, [], []
    hint = "`stillmap convert` makes a recording of another form that can be"
    raise InputError(f"a {form.name} cannot be written again", where=str(mapped.source), hint=hint)


def _without(recording: Recording, blank: NDArray[np.bool_], scratch: Path) -> Recording:
    """Blanked beams went as far as they did, and met nothing."""
    hit = spool.copied(recording.hit, scratch)
    for block in spool.blocks(hit, blank):
        hit[block] &= ~blank[block]
    return dataclasses.replace(recording, hit=hit)
