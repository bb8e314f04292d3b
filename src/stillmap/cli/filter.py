"""`stillmap filter`: the recording again, without the beams that met something moving."""

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap import options
from stillmap.cli.commands import COMMANDS
from stillmap.cli.printing import print_json
from stillmap.cli.progress import say
from stillmap.errors import InputError
from stillmap.evaluation.folders import read_labels
from stillmap.output.atomic import require_new
from stillmap.recording import Recording, carmen_blanked, folder, read
from stillmap.recording.options import ReadOptions

_EPILOG = """examples:
  stillmap filter out -o clean.clf.gz
  stillmap filter out -o clean.log --below 0.3 --input moved/log.log
"""
_MAX_RUN = 256 << 20  # bytes of a run.json


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    p = commands.add_parser(
        "filter",
        help=COMMANDS["filter"],
        description="Write the recording again, in its own format, with the beams blanked that met "
        "something moving: for mappers and localisers that take all they see for static. Nothing "
        "else is changed.",
        epilog=_EPILOG,
    )
    p.add_argument("result", metavar="DIR", help="what `stillmap map` wrote")
    p.add_argument("-o", "--output", metavar="FILE", required=True, help="where the recording goes")
    p.add_argument("--input", metavar="FILE", help="the recording, if it is not where it was")
    p.add_argument(
        "--below",
        metavar="P",
        type=float,
        default=0.5,
        help="blank beams that something static reflected with less than P (default: %(default)g)",
    )
    p.add_argument("--overwrite", action="store_true", help="replace what is there")
    p.add_argument("--json", action="store_true", help="the summary as one JSON object on stdout")
    p.add_argument("--quiet", action="store_true", help="no summary")
    p.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Reads labels and recording, writes the recording without dynamic beams."""
    if not 0.0 <= args.below <= 1.0:
        raise InputError(f"--below wants 0 to 1, got {args.below:g}")
    result, output = Path(args.result), Path(args.output)
    record = _run_record(result / "run.json")
    source = Path(args.input or _path_of(record, result))
    _require_elsewhere(output, source, result, args.overwrite)
    recording = _recording(source, _read_options(record, result), given=bool(args.input))
    labels = read_labels(result)
    _require_same(recording, labels.stamp_ns, labels.offset, source)
    # NaN: unusable anyway
    blank = recording.hit & (labels.p_static < args.below)
    if source.is_dir() or source.name == folder.HEADER:
        folder.write(_without(recording, blank), output, overwrite=args.overwrite)
        left_out = 0
    else:
        left_out = carmen_blanked.write(source, output, recording, blank).left_out
    beams, hits = int(blank.sum()), int(recording.hit.sum())
    if args.json:
        counts = {"hits": hits, "blanked": beams, "lines_left_out": left_out}
        print_json({"output": str(output), "input": str(source), **counts})
    if not args.quiet:
        say(f"{beams} beams blanked, {100.0 * beams / max(hits, 1):.1f} % of the hits; in {output}")
        if left_out:
            say(f"{left_out} lines left out: of scans that were not mapped")
    return 0


def _run_record(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > _MAX_RUN:
            raise InputError("is no record of a run: too large", where=str(path))
        record = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        hint = "DIR is what `stillmap map` wrote"
        raise InputError(f"cannot be read: {error.strerror}", where=str(path), hint=hint) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"is not JSON: {error}", where=str(path)) from error
    if not isinstance(record, dict) or not isinstance(record.get("input"), dict):
        raise InputError("is no record of a run: no input named", where=str(path))
    return record


def _read_options(record: dict[str, Any], result: Path) -> ReadOptions:
    """As the recording was read: the same beams have the same numbers."""
    chosen = record.get("options")
    read_as = chosen.get("read") if isinstance(chosen, dict) else None
    if not isinstance(read_as, dict):
        raise InputError("names no options", where=str(result / "run.json"))
    known = {key: value for key, value in read_as.items() if value is not None}
    try:
        return options.replaced(ReadOptions(), known)
    except (ValueError, InputError) as error:
        raise InputError(f"has options that cannot be: {error}", where=str(result)) from error


def _path_of(record: dict[str, Any], result: Path) -> str:
    path = record["input"].get("path")
    if not isinstance(path, str) or not path:
        where, hint = str(result / "run.json"), "name it with --input"
        raise InputError("names no recording", where=where, hint=hint)
    return path


def _recording(source: Path, read_as: ReadOptions, *, given: bool) -> Recording:
    if not given and not source.exists():
        hint = "that is where it was when it was mapped: name it with --input"
        raise InputError("does not exist", where=str(source), hint=hint)
    return read(source, read_as)


def _require_same(
    recording: Recording, stamp_ns: NDArray[Any], offset: NDArray[Any], source: Path
) -> None:
    if not np.array_equal(recording.stamp_ns, stamp_ns) or not np.array_equal(
        recording.offset, offset
    ):
        raise InputError(
            "is not the recording that was mapped: other scans or beams",
            where=str(source),
            hint="name it with --input",
        )


def _require_elsewhere(output: Path, source: Path, result: Path, overwrite: bool) -> None:
    """Refuse to write over anything but a recording that is not the one that is read."""
    source = source.parent if source.name == folder.HEADER else source
    there, kept = output.resolve(), [source.resolve(), result.resolve()]
    if there == kept[0]:
        raise InputError("is the recording itself", where=str(output))
    if any(there == one or there in one.parents for one in kept):
        raise InputError("holds the recording or the result", where=str(output))
    if source.is_dir():
        is_recording = (output / folder.HEADER).is_file()
        require_new(output, overwrite and is_recording)
    elif output.exists() and not (overwrite and output.is_file()):
        raise InputError(
            "is there already", where=str(output), hint="choose another or give --overwrite"
        )
    elif not there.parent.is_dir():
        raise InputError("cannot be written: no such folder", where=str(output.parent))


def _without(recording: Recording, blank: NDArray[np.bool_]) -> Recording:
    """Blanked beams went as far as they did, and met nothing."""
    return dataclasses.replace(recording, hit=recording.hit & ~blank)
