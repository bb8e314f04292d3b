"""Show what is in a recording: scans, beams, field of view, ranges, duration, odometry and damage;
values estimated from the readings are marked.

examples:
  stillmap info log.clf.gz
  stillmap info sim --json
  stillmap info run_0.bag run_1.bag
  stillmap info log.log --max-range 30 --laser-offset 0.2 0 0

formats:
  CARMEN log          .log .clf .txt, plain or .gz
  ROS bag             .bag .db3 .mcap, a folder of ROS 2
  recording folder    with recording.json, of stillmap
  KITTI folder        with velodyne/ or velodyne_points/
  RGB-D folder        7-Scenes, 3DMatch, TUM RGB-D
  PCD, PLY            a file, or a folder of them
  LAS, E57, 3DTK      likewise
"""

import argparse
import json
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

from stillmap.cli.arguments import JSON, OTHERS, READ, read_options
from stillmap.cli.console import format_rows, print_lines, show_share
from stillmap.core.errors import InputError

# entries of the summary that its text does not show, or shows in its heading
_HIDDEN = ("input", "format", "dimension", "skipped_unit", "records", "read_options")


FLAGS = f"""
input INPUT+  a file or folder with a recording
{JSON}{READ}{OTHERS}"""


def run(args: argparse.Namespace) -> int:
    """Print the summary.

    Raises:
        InputError: the recording cannot be read.
    """
    summaries = [_summarize(path, args) for path in args.input]
    run = _summarize_overlap(summaries, args)
    if args.json:
        content = summaries[0] if len(summaries) == 1 else {"recordings": summaries, **run}
        print(json.dumps(content, indent=2, allow_nan=False))
        return 0
    for number, summary in enumerate(summaries):
        print_lines([*([""] * (number > 0)), *_format_summary(summary)])
    if run:
        print_lines(format_rows(run))
    return 0


def _summarize(path: str, args: argparse.Namespace) -> dict[str, Any]:
    from stillmap.cli.recording_info import summarize_recording
    from stillmap.io import read

    with show_share(args.quiet, "reading") as progress:
        recording = read(path, read_options(args), progress=progress)
    return {"input": path, **summarize_recording(recording)}


def _summarize_overlap(summaries: list[dict[str, Any]], args: argparse.Namespace) -> dict[str, Any]:
    """Number of scans that `stillmap map` uses of overlapping parts of one run, and skips."""
    from stillmap.core.json import to_jsonable
    from stillmap.pipeline import inputs

    times = [summary["time"] for summary in summaries if summary["time"]]
    spans = sorted((time["first_stamp_ns"], time["last_stamp_ns"]) for time in times)
    if not any(after[0] <= before[1] for before, after in pairwise(spans)):
        return {}
    try:
        with show_share(args.quiet, "reading") as progress:
            run = inputs.read(args.input, read_options(args), progress=progress)
    except InputError:  # they are no parts of one run
        return {}
    skipped = to_jsonable(run.source.to_dict()).get("skipped") or {}
    return {"as_one_run": {"scans": run.n_scans, "skipped": skipped}}


def _format_summary(info: dict[str, Any]) -> Iterator[str]:
    yield f"{info['input']}: {info['format'] or 'stillmap recording'}, {info['dimension']}D"
    path = info["path"] if info["path"] != info["input"] else None
    shown = {key: value for key, value in info.items() if key not in _HIDDEN}
    yield from format_rows({"made_from": path, **shown, "path": None})
