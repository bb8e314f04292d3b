"""Groups inputs into runs, and reads the parts of a run as one recording."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io.builder import ReadContext, part_context
from stillmap.io.parts.facts import RecordingFacts, measure_facts
from stillmap.io.parts.grouping import group_parts
from stillmap.io.parts.joining import join_recordings
from stillmap.io.reader import explain_failure, prepare
from stillmap.io.registry import Format, detect_format
from stillmap.io.text_lines import Progress
from stillmap.prepare.options import ReadOptions
from stillmap.prepare.time_window import TimeWindow, select_time


@dataclass(frozen=True)
class InputGroup:
    """Inputs that belong together.

    Attributes:
        paths: in order of time.
        kind: `parts` of one run, or a `recording` of its own.
        why: one sentence.
        parts: for `Recording.source`: path, scans, first and last stamp of each; empty for one.
    """

    paths: tuple[str, ...]
    kind: str
    why: str
    parts: tuple[dict[str, Any], ...] = ()


def group_inputs(
    paths: Sequence[str],
    options: ReadOptions | None = None,
    *,
    progress: Progress | None = None,
    scratch: Path | None = None,
) -> list[InputGroup]:
    """Find which inputs are parts of one run; each is read, one after the other.

    Args:
        paths: of recordings, in any order.
        options: read options; the time window does not apply.
        progress: called with the share that is read, 0 to 1.
        scratch: folder for memory-mapped buffers; None: the system's temporary folder.

    Returns:
        The groups, in the order of the first of their inputs.

    Raises:
        InputError: one of them cannot be read.
    """
    if len(paths) == 1:
        return [InputGroup(tuple(paths), "recording", "the only input")]
    context = ReadContext(options or ReadOptions(), progress, scratch)
    facts = [_read_facts(paths, number, context) for number in range(len(paths))]
    return [
        InputGroup(
            tuple(paths[k] for k in group.members),
            group.kind,
            group.why,
            tuple(_describe_part(facts[k]) for k in group.members) if group.kind == "parts" else (),
        )
        for group in group_parts(facts)
    ]


def _read_facts(paths: Sequence[str], number: int, context: ReadContext) -> RecordingFacts:
    """The facts of one of several inputs, which may state what the others lack."""
    path = Path(paths[number])
    with explain_failure(path):
        form, context = detect_format(path), part_context(context, number, len(paths))
        if form.read_parts is None:
            recording = form.read(path, context)
        else:
            others = [Path(one) for k, one in enumerate(paths) if k != number]
            same = [one for one in others if detect_format(one) is form]
            recording = form.read_parts([path], context, same)
        if not recording.n_scans:
            raise InputError("holds no scan", where=str(path))
        return measure_facts(recording, paths[number])


def _describe_part(facts: RecordingFacts) -> dict[str, Any]:
    return {
        "path": facts.path,
        "scans": len(facts.stamp_ns),
        "first_stamp_ns": facts.first_ns,
        "last_stamp_ns": facts.last_ns,
    }


def read_parts(
    paths: Sequence[str | Path],
    options: ReadOptions | None = None,
    *,
    progress: Progress | None = None,
    scratch: Path | None = None,
) -> Recording:
    """Read the parts of one run as one recording.

    Args:
        paths: of the parts, in order of time.
        options, progress, scratch: see `stillmap.io.read`; the time window counts from the start
            of the first part.

    Raises:
        InputError: a part cannot be read, or does not fit the others.
    """
    files, options = [Path(path) for path in paths], options or ReadOptions()
    context = ReadContext(options, progress, scratch)
    with explain_failure(files[0]):
        forms = [detect_format(path) for path in files]
        if forms[0].read_parts is not None and all(form is forms[0] for form in forms):
            recording = forms[0].read_parts(files, context, ())
        else:
            recording = _join(files, forms, context)
        recording = prepare(recording, options, scratch, str(files[0]))
    if len(files) > 1:
        recording.source["parts"] = [{"path": str(path)} for path in files]
    return recording


def _join(files: list[Path], forms: list[Format], context: ReadContext) -> Recording:
    count = len(files)
    parts = (
        form.read(path, part_context(context, number, count))
        for number, (path, form) in enumerate(zip(files, forms, strict=True))
    )
    joined = join_recordings(parts, [str(path) for path in files], context.scratch)
    if not (window := TimeWindow(context.options)):
        return joined
    return replace(select_time(joined, window, str(files[0])), scratch=context.scratch)
