"""`stillmap map --tilting`: a second recording, of a laser that builds in 3D."""

import argparse
import dataclasses
from pathlib import Path

import numpy as np

from stillmap.cli.console import shown_share
from stillmap.core.errors import InputError
from stillmap.core.parallel import limit_blas_threads, resolve_threads
from stillmap.core.recording import Recording
from stillmap.io import read
from stillmap.io.registry import detect_format
from stillmap.io.text_lines import Progress
from stillmap.mapping.beam_statistics import count_beams
from stillmap.pipeline.options import Options
from stillmap.results.result import Result
from stillmap.rig.build import PlanarResult, TiltingResult, build_tilting, check_rig


def read_tilting(
    args: argparse.Namespace, flat: Recording, options: Options, scratch: Path
) -> Recording | None:
    """The recording of the laser that tilts; None where none was named.

    Raises:
        InputError: it cannot be read, or is not of the same robot and time as the flat one.
    """
    named = options.read.tilting_topic
    if args.tilting and named is not None:
        raise InputError("--tilting and --tilting-topic exclude each other")
    if not args.tilting and named is None:
        return None
    if flat.dimension != 2:
        what = "the laser that decides what moves lies flat, this recording is in 3D"
        raise InputError(what, where=args.input)
    with shown_share(args.quiet, "reading") as tell:
        if named is not None:
            found = _of_topic(Path(args.input), named, flat, options, tell, scratch)
        else:
            # what was chosen of one recording is not in the other one
            read_as = dataclasses.replace(options.read, topic=None)
            found = read(Path(args.tilting), read_as, progress=tell, scratch=scratch)
    path = args.tilting or args.input
    check_rig(flat, found, path)
    return dataclasses.replace(found, source={**found.source, "path": path})


def _of_topic(
    path: Path,
    topic: str,
    flat: Recording,
    options: Options,
    tell: Progress | None,
    scratch: Path,
) -> Recording:
    """The laser that tilts, of the same bag as the flat one, on the same robot."""
    from stillmap.io.ros.reader import read_tilting  # types of messages take long to load

    if detect_format(path).name != "ROS bag":
        raise InputError("--tilting-topic is for bags", where=str(path))
    base = flat.source.get("base_frame")
    read_as = dataclasses.replace(
        options.read, topic=topic, tilting_topic=None, base_frame=base if base else None
    )
    with np.errstate(over="ignore", invalid="ignore"):
        return read_tilting(path, read_as, tell, scratch)


@limit_blas_threads()
def built(result: Result, tilting: Recording, options: Options) -> TiltingResult:
    """What that laser built, once the flat one knows what moves."""
    flat = PlanarResult.from_labels(result.seen, result.poses, result.p_static, result.objects)
    threads = resolve_threads(options.threads)
    return build_tilting(flat, tilting, options.rig, options.objects, options.em, threads)


def said(tilting: TiltingResult) -> str:
    """A line about it."""
    counts = count_beams(tilting.deskewed, tilting.p_static)
    out = (
        f"in 3D {counts['hits']} beams that hit something, "
        f"{100.0 * counts['dynamic'] / max(counts['hits'], 1):.1f} % of them dynamic"
    )
    if tilting.unposed_beams:
        out += f"; {tilting.unposed_beams} left out: nobody knows where the robot was"
    return out
