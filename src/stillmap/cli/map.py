"""`stillmap map`: parse, read, build, save."""

import argparse
import errno
import os
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from stillmap.cli.arguments import add_read_flags, read_changes, require_apart
from stillmap.cli.config import add_option_flags, options_from_args
from stillmap.cli.console import print_json, say, show_progress
from stillmap.cli.map_flags import (
    add_map_flags,
    add_method_flags,
    add_run_flags,
    option_changes,
)
from stillmap.cli.map_summary import print_summary, summarize
from stillmap.core.errors import InputError, is_out_of_memory, memory_error

if TYPE_CHECKING:
    from stillmap.core.profiling import StageTimer
    from stillmap.io.input_groups import InputGroup
    from stillmap.pipeline.checkpoint import CheckpointFolder
    from stillmap.pipeline.options import Options

DESCRIPTION = (
    "Map a recording: estimate the pose of every scan, the probability of every "
    "beam to have hit something static, and the map of what is static. The result is a folder; "
    "open it with `stillmap view`. Several inputs are joined where they are parts of one run."
)
EPILOG = """examples:
  stillmap map log.clf.gz -o out
  stillmap map sim -o out --overwrite --resolution 0.1
  stillmap map log.clf.gz -o out --min-range 0.3 --set em.max_iterations=3
  stillmap map log.clf.gz -o out --poses poses.tum --config options.toml
  stillmap map log.bag -o out --resume
  stillmap map run_0.bag run_1.bag run_2.bag -o out
  stillmap map sim/horizontal -o out --tilting sim/tilting
  stillmap map log.clf.gz -o out --quiet --json
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the flags and arguments."""
    p.add_argument(
        "input",
        metavar="INPUT",
        nargs="+",
        help="a CARMEN log, a ROS bag, a stillmap recording folder, ...: see docs/input.md; "
        "several: the parts of one run, in any order (docs/input.md)",
    )
    p.add_argument(
        "--tilting",
        metavar="RECORDING",
        help="recording of a tilting laser on the same robot, mapped in 3D: INPUT, of the planar "
        "laser, decides what moves (docs/rig.md)",
    )
    p.add_argument(
        "--tilting-topic",
        metavar="TOPIC",
        help="the same for a topic of the bag INPUT; its transforms give the laser's motion",
    )
    p.add_argument("-o", "--output", metavar="DIR", required=True, help="result folder")
    p.add_argument("--overwrite", action="store_true", help="replace what is in DIR")
    p.add_argument(
        "--resume", action="store_true", help="continue an interrupted run from its last checkpoint"
    )
    add_run_flags(p)
    add_method_flags(p.add_argument_group("method"))
    add_map_flags(p.add_argument_group("map"))
    add_read_flags(p)
    add_option_flags(p)


_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def run(args: argparse.Namespace) -> int:
    """Map a recording into a folder."""
    from stillmap.cli.map_run import build_all, read_inputs
    from stillmap.core.profiling import StageTimer
    from stillmap.pipeline.checkpoint import lock_checkpoints
    from stillmap.results.save import save

    options = options_from_args(args, read_changes(args), option_changes(args))
    output, stages = Path(args.output), StageTimer()
    _require_usable_output(args, output)
    groups = _find_groups(args, options, output, stages)
    if len(groups) > 1:
        return _merge_sessions(args, groups)
    with lock_checkpoints(output) as checkpoints, _explain_failure(args, checkpoints):
        inputs = read_inputs(args, groups[0], options, checkpoints.folder, stages)
        with show_progress(args.quiet, options.em.max_iterations) as progress:
            result, tilting, models = build_all(args, inputs, checkpoints, progress, stages)
            progress("writing", 0, 0, 0)
            save(
                result,
                output,
                args.overwrite or args.resume,
                tilting=tilting,
                models=models,
            )
        checkpoints.clear()
    if not args.quiet:
        print_summary(result, tilting, models, output)
    if args.json:
        print_json(summarize(output))
    return 0


def _find_groups(
    args: argparse.Namespace, options: "Options", output: Path, stages: "StageTimer"
) -> "list[InputGroup]":
    """Group the inputs and tell how; what is large lies beside the output meanwhile."""
    from stillmap.cli.groups import describe_group, find_groups
    from stillmap.pipeline.checkpoint import lock_checkpoints

    if len(args.input) == 1:
        return find_groups(args, options.read, None)
    with (
        lock_checkpoints(output) as checkpoints,
        _explain_failure(args, checkpoints),
        stages.measure("read"),
    ):
        groups = find_groups(args, options.read, checkpoints.folder)
    if not args.quiet:
        for group in groups:
            say(describe_group(group))
    return groups


def _merge_sessions(args: argparse.Namespace, groups: "list[InputGroup]") -> int:
    """Map sessions and merge them, each a recording or the parts of one.

    Raises:
        InputError: a flag is for one recording, or sessions cannot be merged.
    """
    from stillmap.cli.groups import require_for_sessions
    from stillmap.cli.merge import merge_groups

    require_for_sessions(args, groups)
    return merge_groups(args, [list(group.paths) for group in groups])


def _require_usable_output(args: argparse.Namespace, output: Path) -> None:
    """Refuse an output that is taken, holds an input or cannot be written, before any work."""
    from stillmap.core.files import require_new, workplace
    from stillmap.results.run_json import RECORD

    require_new(output, RECORD, args.overwrite or args.resume)
    for source in filter(None, (*args.input, args.tilting)):
        require_apart(output, Path(source))
    parent = workplace(output)
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(f"cannot be written: {parent} is not writable", where=str(output))


@contextmanager
def _explain_failure(args: argparse.Namespace, checkpoints: "CheckpointFolder") -> Iterator[None]:
    """Say after a failure or an interruption how to go on; report a full disk in one line."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit):
        if not args.quiet:
            say(_describe_continuation(args.words, checkpoints))
        raise
    except Exception as error:
        reason = memory_error(error) if is_out_of_memory(error) else error
        if isinstance(reason, InputError | OSError):
            raise _with_continuation(reason, args, checkpoints) from error
        if checkpoints.is_in_use:
            say(_describe_continuation(args.words, checkpoints))
        raise


def _with_continuation(
    error: InputError | OSError, args: argparse.Namespace, checkpoints: "CheckpointFolder"
) -> InputError | OSError:
    """The error, with how to go on if there is anything to go on with."""
    if isinstance(error, OSError):
        if error.errno not in _DISK_FULL and not checkpoints.is_in_use:
            return error
        what = f"cannot continue: {error.strerror or error}"
        error = InputError(what, where=str(error.filename or checkpoints.folder))
    if not checkpoints.is_in_use:
        return error
    hints = filter(None, (error.hint, _describe_continuation(args.words, checkpoints)))
    return InputError(error.what, where=error.where, hint="; ".join(hints))


def _describe_continuation(words: list[str], checkpoints: "CheckpointFolder") -> str:
    """The command that continues a run that ended early, with these words on its command line."""
    if checkpoints.newest is None:
        return "no iteration was finished: nothing was written, and there is nothing to resume"
    given = [word for word in words if word not in ("--resume", "--overwrite")]
    number = checkpoints.newest.name.rpartition("-")[2]
    command = shlex.join(["stillmap", *given, "--resume"])
    return f"continue after iteration {number}: {command}"
