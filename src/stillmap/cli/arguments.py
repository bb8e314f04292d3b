"""Flags made from the options, and checks of output paths; shared by the commands."""

import argparse
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.core.config import (
    OptionInfo,
    iter_options,
    load_toml,
    merge_nested,
    nest,
    override,
    parse_assignment,
)
from stillmap.core.errors import InputError, cannot_write

if TYPE_CHECKING:
    from stillmap.pipeline.options import Options
    from stillmap.prepare.options import ReadOptions

# flag -> option, which gives help, type, choices and default
_READ_FLAGS = {
    "--min-range": "read.min_range",
    "--max-range": "read.max_range",
    "--zero-means": "read.zero_means",
    "--spin": "read.spin",
    "--cameras": "read.cameras",
    "--topic": "read.topic",
    "--base-frame": "read.base_frame",
    "--odom-frame": "read.odom_frame",
    "--laser-upside-down": "read.laser_upside_down",
    "--laser2-upside-down": "read.laser2_upside_down",
    "--from": "read.start",
}
_END = "read.end"  # its flag is --to or --until: `convert --to` is a format
_PLACE_FLAGS = {"--resolution": "slam.resolution", "--map-mode": "output.map_mode"}
_MAP_FLAGS = {
    "--mesh": "mesh.enabled",
    **_PLACE_FLAGS,
    "--region": "output.region",
    "--map-state": "output.map_state",
}
_UNITS = {"metre": "M", "second": "S", "file": "FILE.toml", "topic": "TOPIC", "frame": "FRAME"}


def add_flags(
    group: argparse._ActionsContainer, flags: Mapping[str, str], options: Any, prefix: str = ""
) -> None:
    """Add flags that set options; the name of the option is the argument's."""
    infos = {info.name: info for info in iter_options(options, prefix)}
    for flag, name in flags.items():
        group.add_argument(*flag.split(), dest=name, **_settings(infos[name]))


def _settings(info: OptionInfo) -> dict[str, Any]:
    """Arguments of `add_argument` for an option."""
    kind, default = info.kind.removesuffix(" or unset"), info.default
    shown = "" if default is None or kind == "bool" else f" (default: {default})"
    settings: dict[str, Any] = {"help": info.doc.replace("%", "%%") + shown}
    if info.choices:
        return settings | {"choices": info.choices}
    if kind == "bool":
        return settings | {"action": argparse.BooleanOptionalAction}
    if kind == "list":
        return settings | {"type": float, "nargs": 4, "metavar": ("X0", "Y0", "X1", "Y1")}
    if info.name == "read.topic":
        settings["action"] = "append"
    unit = next((short for word, short in _UNITS.items() if word in info.doc.lower()), "N")
    return settings | {"type": {"float": float, "int": int}.get(kind, str), "metavar": unit}


def add_read_flags(
    p: argparse.ArgumentParser, end_flags: tuple[str, ...] = ("--to", "--until")
) -> None:
    """Add the flags for reading a recording to a command; `end_flags` name the end of its part."""
    from stillmap.prepare.options import ReadOptions

    group = p.add_argument_group("reading the recording")
    add_flags(group, _READ_FLAGS | {" ".join(end_flags): _END}, ReadOptions(), "read.")
    for laser in ("laser", "laser2"):
        which = "second" if laser == "laser2" else "first"
        group.add_argument(
            f"--{laser}-offset",
            type=float,
            nargs=3,
            metavar=("X", "Y", "DEG"),
            help=f"pose of the {which} laser on the robot: m ahead, m left, degrees to the left",
        )
        group.add_argument(
            f"--{laser}-fov",
            dest=f"read.{laser}_fov",
            type=_radians,
            metavar="DEG",
            help=f"field of view of the {which} laser in FLASER and RLASER lines (default: 180)",
        )


def _radians(degrees: str) -> float:
    return math.radians(float(degrees))


def add_run_flags(p: argparse.ArgumentParser) -> None:
    """Add the flags of how the command itself runs and what it prints."""
    from stillmap.pipeline.options import DEFAULTS

    add_flags(p, {"--threads": "threads"}, DEFAULTS)
    p.add_argument("--json", action="store_true", help="a summary as one JSON object on stdout")
    p.add_argument("--quiet", action="store_true", help="no progress, no summary")


def add_method_flags(p: argparse._ArgumentGroup) -> None:
    """Add the flags that choose how poses and labels are estimated."""
    from stillmap.pipeline.options import DEFAULTS

    either = p.add_mutually_exclusive_group()
    either.add_argument(
        "--paper",
        dest="estimator",
        action="store_const",
        const="paper",
        help="the method exactly as printed",
    )
    add_flags(either, {"--estimator": "estimator"}, DEFAULTS)
    p.add_argument(
        "--poses",
        metavar="FILE.tum",
        help="keep these poses; `recording`: the poses stored in the recording",
    )
    p.add_argument("--no-odometry", action="store_true", help="ignore odometry in the recording")


def add_map_flags(p: argparse._ActionsContainer, *, whole: bool = True) -> None:
    """Add the flags of the map that is written; `whole`: all of them, not of a place alone."""
    from stillmap.pipeline.options import DEFAULTS

    add_flags(p, _MAP_FLAGS if whole else _PLACE_FLAGS, DEFAULTS)


def add_option_flags(p: argparse.ArgumentParser) -> None:
    """Add `--config` and `--set`."""
    group = p.add_argument_group("any other option, see `stillmap config`")
    group.add_argument("--config", metavar="FILE.toml", help="options from a TOML file")
    add_set_flag(group, "one option, e.g. em.prior=0.8; can be given again")


def add_set_flag(p: argparse._ActionsContainer, help: str) -> None:
    """Add `--set`; the last value of an option counts."""
    p.add_argument(
        "--set",
        dest="assignments",
        metavar="SECTION.KEY=VALUE",
        action="append",
        default=[],
        help=help,
    )


def flag_changes(args: argparse.Namespace) -> dict[str, Any]:
    """The options that flags set, as nested changes."""
    given = {name: value for name, value in vars(args).items() if value is not None}
    named = {name: value for name, value in given.items() if re.fullmatch(r"[a-z]+\.\w+", name)}
    named |= {name: given[name] for name in ("threads", "estimator") if name in given}
    if "slam.resolution" in named:
        named["slam.voxel_size"] = named["slam.resolution"]
    if "read.topic" in named:
        named["read.topic"] = ",".join(named["read.topic"])
    for laser in ("laser", "laser2"):
        if offset := given.get(f"{laser}_offset"):
            x, y, degrees = offset
            keys = (f"read.{laser}_x", f"read.{laser}_y", f"read.{laser}_theta")
            named |= zip(keys, (x, y, math.radians(degrees)), strict=True)
    return nest(named)


def options_from_args(args: argparse.Namespace) -> "Options":
    """Resolve options by precedence: default < file < --set < flag.

    Raises:
        InputError: an unknown key or a wrong value, and where it came from.
    """
    from stillmap.pipeline.options import Options

    options = Options()
    if args.config:
        options = override(options, load_toml(Path(args.config)), args.config)
    options = override(options, merge_nested(*map(parse_assignment, args.assignments)), "--set")
    return override(options, flag_changes(args))


def read_options(args: argparse.Namespace) -> "ReadOptions":
    """The options of reading; the others take long to load, and are only for --config, --set."""
    from stillmap.prepare.options import ReadOptions

    if getattr(args, "config", None) or getattr(args, "assignments", None):
        return options_from_args(args).read
    return override(ReadOptions(), flag_changes(args).get("read", {}))


@contextmanager
def make_parents(output: Path) -> Iterator[None]:
    """Create the parent folders of an output; remove them again if the block fails.

    Raises:
        InputError: they cannot be created, or the output cannot be written there; before anything
            is read.
    """
    from stillmap.core.files import resolve_output, temporary_folder

    parent = resolve_output(output).parent
    created: list[Path] = []
    try:
        try:
            for folder in reversed((parent, *parent.parents)):
                if not folder.exists():
                    created.append(folder)  # an interruption right after it was made finds it
                    folder.mkdir(exist_ok=True)
            # the writer reports a device at this path
            if not output.exists() or output.is_file() or output.is_dir():
                with temporary_folder(output):
                    pass
        except OSError as error:
            raise cannot_write(error, output) from error
        yield
    except BaseException:
        with suppress(OSError):  # not empty
            for folder in reversed(created):
                folder.rmdir()
        raise


def require_apart(output: Path, *inputs: Path) -> None:
    """Refuse to overwrite what is read, or a folder that holds it.

    Raises:
        InputError: the output is the first input, or holds one of them.
    """
    is_header = inputs[0].name == "recording.json"  # stands for its folder
    sources = [(inputs[0].parent if is_header else inputs[0]).resolve()]
    sources += [path.resolve() for path in inputs[1:]]
    target = output.resolve()
    if target == sources[0]:
        raise InputError("is the recording itself", where=str(output))
    if any(target == path or target in path.parents for path in sources):
        raise InputError("holds the recording or the result", where=str(output))
