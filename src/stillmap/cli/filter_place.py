"""`stillmap filter PLACE`: the recordings of all its sessions with their dynamic beams blanked."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.cli.arguments import require_apart
from stillmap.cli.console import print_json, say
from stillmap.cli.filter_recording import Filtered, find_target, write_filtered
from stillmap.core.errors import InputError

if TYPE_CHECKING:
    from stillmap.io.filter_writers import FilterTarget
    from stillmap.results.folder import ResultFolder

_INDEX = "filtered.json"  # the list of what such a folder holds


@dataclass(frozen=True, eq=False)
class _Session:
    """A session of the place that is written again.

    Attributes:
        name: in the place.
        result: its folder.
        file: name of the filtered recording.
        target: how it is written.
    """

    name: str
    result: "ResultFolder"
    file: str
    target: "FilterTarget"


def filter_place(args: argparse.Namespace, place: Path, output: Path) -> None:
    """Write a folder with the filtered recording of every session, complete or not at all.

    Raises:
        InputError: a recording is not there any more, or the output is taken.
    """
    from stillmap.core.files import atomic_folder, require_new
    from stillmap.core.json import write_json

    if args.input is not None:
        hint = f"one by one: stillmap filter {place}/sessions/NAME -o FILE --input FILE"
        raise InputError("has several recordings: --input names one", where=str(place), hint=hint)
    require_new(output, _INDEX, args.overwrite)
    sessions = [_plan(place, name, output, args.to) for name in _list_names(place)]
    with atomic_folder(output, _INDEX, args.overwrite) as folder, _as_final(folder, output):
        records = []
        for one in sessions:
            done = write_filtered(one.result, one.target, folder / one.file, args)
            records.append(_record(one, done))
            if not args.quiet:
                _report(one, done)
        write_json(folder / _INDEX, records)
    if args.json:
        print_json({"output": str(output), "sessions": records})
    if not args.quiet:
        say(f"wrote {output}")


def _list_names(place: Path) -> list[str]:
    from stillmap.places.reader import read_sessions

    return [record["name"] for record in read_sessions(place) if record["accepted"]]


def _plan(place: Path, name: str, output: Path, to: str | None) -> _Session:
    """Plan how a session is written; what cannot be is refused before any is read.

    Raises:
        InputError: its recording is not there, or cannot be written so.
    """
    from stillmap.io import filter_writers
    from stillmap.results.folder import open_result

    require_apart(output, place)
    try:
        result = open_result(place / "sessions" / name)
        _ = result.read_options
        result.require_source()
    except InputError as error:
        hint = f"stillmap filter {place}/sessions/{name} -o FILE --input FILE finds it elsewhere"
        raise InputError(error.what, where=error.where, hint=hint) from error
    file = name + _find_ending(result, to)
    target = find_target(result, output / file, to)
    for source in result.sources:
        require_apart(output, source, place)
        filter_writers.require_outside(output, source)
    return _Session(name, result, file, target)


def _find_ending(result: "ResultFolder", to: str | None) -> str:
    """The ending of the recording's own format, or of another one; none of folders."""
    from stillmap.io import writers

    own = "" if result.parts else _own_ending(result.source)
    if to is None:
        return own
    endings = writers.find_writer(result.source, to).endings
    return own if own.lower() in endings else next(iter(endings), "")


def _own_ending(source: Path) -> str:
    """The ending of a file's name by its format, such as `.log.gz`; none of a folder."""
    from stillmap.io import registry, stillmap_folder

    name = source.name
    if source.is_dir() or name == stillmap_folder.HEADER:
        return ""
    known = [end for form in registry.FORMATS for end in form.endings if end.startswith(".")]
    fitting = [len(end) for end in known if name.lower().endswith(end)]
    return name[len(name) - max(fitting) :] if fitting else source.suffix


@contextmanager
def _as_final(staging: Path, output: Path) -> Iterator[None]:
    """Errors about files in the temporary folder name them where they would have been."""
    try:
        yield
    except InputError as error:
        where, what = (
            text.replace(str(staging), str(output)) for text in (error.where, error.what)
        )
        raise InputError(what, where=where, hint=error.hint) from error


def _record(one: _Session, done: Filtered) -> dict[str, Any]:
    return {
        "name": one.name,
        "file": one.file,
        "input": str(one.result.source),
        **({"parts": list(map(str, one.result.parts))} if one.result.parts else {}),
        "hits": done.hits,
        "blanked": done.blanked,
        "scans_left_out": done.left_out,
    }


def _report(one: _Session, done: Filtered) -> None:
    say(f"{one.file}: {done.describe()}")
    if done.left_out:
        say(f"{one.file}: {done.left_out} scans left out that were not mapped")
    for note in done.notes:
        say(f"warning: {one.file}: {note}")
