"""Map a recording: estimate the pose of every scan, the probability of every beam to have hit
something static, and the map of what is static. The result is a folder; open it with `stillmap
view`. Several inputs are parts of one run, joined in the order of their stamps.

examples:
  stillmap map log.clf.gz -o out
  stillmap map sim -o out --overwrite --resolution 0.1
  stillmap map log.clf.gz -o out --min-range 0.3 --set em.max_iterations=3
  stillmap map log.clf.gz -o out --poses poses.tum --config options.toml
  stillmap map log.bag -o out --resume
  stillmap map run_0.bag run_1.bag run_2.bag -o out
  stillmap map sim/horizontal -o out --tilting sim/tilting
  stillmap map log.clf.gz -o out --quiet --json
"""

import argparse
import shlex
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from stillmap.cli import arguments
from stillmap.cli.console import print_json, say, show_progress
from stillmap.core.errors import InputError, is_out_of_memory, memory_error

if TYPE_CHECKING:
    from stillmap.core.recording import Recording
    from stillmap.pipeline.checkpoint import CheckpointFolder


FLAGS = f"""
input INPUT+  a CARMEN log, a ROS bag, a stillmap recording folder, ...; several: the parts of one
  run, in any order
--tilting RECORDING  recording of a tilting laser on the same robot, mapped in 3D: INPUT, of the
  planar laser, decides what moves
--tilting-topic -> read.tilting_topic
-o --output DIR!  result folder
{arguments.OVERWRITE}
--resume  continue an interrupted run from its last checkpoint
{arguments.RUN}{arguments.METHOD}{arguments.READ}{arguments.OTHERS}"""


def run(args: argparse.Namespace) -> int:
    """Map a recording into a folder."""
    from stillmap.cli.map_run import build_all, print_summary, read_inputs, summarize
    from stillmap.core.profiling import StageTimer
    from stillmap.pipeline.checkpoint import lock_checkpoints
    from stillmap.results.writer import save

    options = arguments.options_from_args(args)
    output, stages = Path(args.output), StageTimer()
    _require_usable_output(args, output)
    with lock_checkpoints(output) as checkpoints, _explain_failure(args, checkpoints):
        with stages.measure("read"):
            inputs = read_inputs(args, options, checkpoints.folder)
        if args.resume and not args.overwrite and checkpoints.newest is None:
            _require_own_result(args, output, inputs.recording)
        with show_progress(args.quiet, options.em.max_iterations) as progress:
            result, tilting, models = build_all(args, inputs, checkpoints, progress, stages)
            progress("writing", 0, 0, 0)
            replace = args.overwrite or args.resume
            save(result, output, replace, tilting=tilting, models=models)
        checkpoints.clear()
    if not args.quiet:
        print_summary(result, tilting, models, output)
    if args.json:
        print_json(summarize(output))
    return 0


def _require_usable_output(args: argparse.Namespace, output: Path) -> None:
    """Refuse an output that is taken or holds an input, before any work."""
    from stillmap.core.files import require_new
    from stillmap.results.reader import RECORD

    require_new(output, RECORD, args.overwrite or args.resume)
    for source in filter(None, (*args.input, args.tilting)):
        arguments.require_apart(output, Path(source))


def _require_own_result(args: argparse.Namespace, output: Path, recording: "Recording") -> None:
    """Refuse to replace the result of another recording; `--overwrite` does.

    Raises:
        InputError: `output` is one.
    """
    from stillmap.results.folder import match_labels, open_result
    from stillmap.results.reader import is_result, read_labels

    if not is_result(output):
        return
    with suppress(InputError):
        sources = {path.resolve() for path in open_result(output).sources}
        if sources != {Path(path).resolve() for path in args.input}:  # it may have been moved
            match_labels(recording, read_labels(output), "")
        return
    what, hint = "holds the result of another recording", "choose another or give overwrite=True"
    raise InputError(what, where=str(output), hint=hint)


@contextmanager
def _explain_failure(args: argparse.Namespace, checkpoints: "CheckpointFolder") -> Iterator[None]:
    """Say after a failure or an interruption how to go on, where there is something to go on."""
    try:
        yield
    except BaseException as error:
        failure = memory_error(error) if is_out_of_memory(error) else error
        continuation = _describe_continuation(args.words, checkpoints)
        if isinstance(failure, InputError) and checkpoints.is_in_use:
            hint = "; ".join(filter(None, (failure.hint, continuation)))
            raise InputError(failure.what, where=failure.where, hint=hint) from error
        is_interrupt = isinstance(error, KeyboardInterrupt | SystemExit)
        if not args.quiet if is_interrupt else checkpoints.is_in_use:
            say(continuation)
        raise


def _describe_continuation(words: list[str], checkpoints: "CheckpointFolder") -> str:
    """The command that continues a run that ended early, with these words on its command line."""
    if checkpoints.newest is None:
        return "no iteration was finished: nothing was written, and there is nothing to resume"
    given = [word for word in words if word not in ("--resume", "--overwrite")]
    number = checkpoints.newest.name.rpartition("-")[2]
    command = shlex.join(["stillmap", *given, "--resume"])
    return f"continue after iteration {number}: {command}"
