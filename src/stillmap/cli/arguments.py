"""Flags as text, the options that they set, and checks of output paths; shared by the commands.

A command has a table of its flags and arguments, one a line; lines that go on are indented.

    NAMES [TAKES] [= DEFAULT] [-> DEST]  HELP

TAKES is what follows, as the help calls it, and several words stand for several values. It ends
with `!` if the flag is required, with `?`, `*` or `+` as in regular expressions, with `...` if the
flag can be given again; `{a,b}` are choices. A flag without it is a switch, which sets DEST=VALUE.
Without HELP, the option DEST gives everything. One of the flags behind `|` can be given. A line
that ends with a colon begins a group.
"""

import argparse
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.core import config
from stillmap.core.errors import InputError, explaining_refusal

if TYPE_CHECKING:
    from stillmap.pipeline.options import Options
    from stillmap.prepare.options import ReadOptions

OVERWRITE = "--overwrite  replace what is there\n"
JSON = "--json  a summary as one JSON object on stdout\n"
NO_ODOMETRY = "--no-odometry  ignore odometry in the recording\n"
RUN = f"--threads -> threads\n{JSON}"
PLACE_MAP = """
--resolution -> slam.resolution
--map-mode -> output.map_mode
"""
METHOD = f"""
method:
| --paper -> estimator=paper  the method exactly as printed
| --estimator -> estimator
--poses FILE.tum  keep these poses; `recording`: the poses stored in the recording
{NO_ODOMETRY}
map:
--mesh -> mesh.enabled
{PLACE_MAP}
--region -> output.region
--map-state -> output.map_state
"""
OTHERS = """
any other option, see `stillmap config`:
--config FILE.toml  options from a TOML file
--set SECTION.KEY=VALUE... -> assignments  one option, e.g. em.prior=0.8; can be given again
"""
READ = """
reading the recording:
--min-range -> read.min_range
--max-range -> read.max_range
--zero-means -> read.zero_means
--spin -> read.spin
--cameras -> read.cameras
--topic -> read.topic
--base-frame -> read.base_frame
--odom-frame -> read.odom_frame
--laser-upside-down -> read.laser_upside_down
--laser2-upside-down -> read.laser2_upside_down
--from -> read.start
--to --until -> read.end
--laser-offset X Y DEG  pose of the first laser on the robot: m ahead, m left, degrees to the left
--laser-fov DEG -> read.laser_fov  field of view of the first laser in FLASER and RLASER lines
  (default: 180)
--laser2-offset X Y DEG  pose of the second laser likewise
--laser2-fov DEG -> read.laser2_fov  field of view of the second laser likewise (default: 180)
"""

_ROW = re.compile(
    r"(?P<either>\| )?(?P<names>[\w-]+( -[\w-]+)*)"
    r"( (?P<takes>[^-= |].*?)(?P<nargs>\.\.\.|[!?*+])?)?( = (?P<default>\S+))?"
    r"( -> (?P<dest>[\w.]+)(=(?P<value>\w+))?)?(  (?P<help>.*))?"
)


def degrees(text: str) -> float:
    """The radians of a number of degrees on the command line."""
    return math.radians(float(text))


# of what follows a flag; others are texts
_TYPES = {"N": int, "DEG": degrees, **dict.fromkeys(("S", "M", "P", "X", "HZ", "GB"), float)}
_UNITS = {"metre": "M", "second": "S", "file": "FILE.toml", "topic": "TOPIC", "frame": "FRAME"}
_KINDS = {"float": float, "int": int}


def add_flags(p: argparse.ArgumentParser, table: str) -> None:
    """Add the flags and arguments of a table to the parser of a command."""
    group: argparse._ActionsContainer = p
    either: argparse._ActionsContainer | None = None
    for line in re.sub(r"\n +", " ", table).splitlines():
        row = _ROW.fullmatch(line)
        if line.endswith(":"):
            group, either = p.add_argument_group(line[:-1]), None
        elif row is not None and row["either"]:
            either = either or group.add_mutually_exclusive_group()
            either.add_argument(*row["names"].split(), **_settings(row))
        elif row is not None:
            group.add_argument(*row["names"].split(), **_settings(row))
        elif line:
            raise ValueError(f"flags: expected NAMES TAKES  HELP, got {line}")


def _settings(row: re.Match[str]) -> dict[str, Any]:
    """Arguments of `add_argument` for a line of a table."""
    settings: dict[str, Any] = {"dest": row["dest"]} if row["dest"] else {}
    if row["help"] is None:
        return settings | _settings_of_option(row["dest"])
    settings["help"] = row["help"]
    if row["takes"] is None:
        settings["default"] = None if row["dest"] else False  # options stay as they are
        return settings | {"action": "store_const", "const": row["value"] or True}
    words, nargs = row["takes"].split(), row["nargs"]
    settings["type"] = _TYPES.get(row["takes"], str) if len(words) == 1 else float
    if row["takes"].startswith("{"):
        settings["choices"] = row["takes"].strip("{}").split(",")
    else:
        settings["metavar"] = words[0] if len(words) == 1 else tuple(words)
    if row["default"] is not None:
        settings["default"] = settings["type"](row["default"])
        settings["help"] += " (default: %(default)s)"
    if nargs == "...":
        settings |= {"action": "append", "default": []}
    elif nargs == "!":
        settings["required"] = True
    elif nargs or len(words) > 1:
        settings["nargs"] = nargs or len(words)
    return settings


def _settings_of_option(name: str) -> dict[str, Any]:
    """Arguments of `add_argument` for a flag that sets an option."""
    info = _find_option(name)
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
    return settings | {"type": _KINDS.get(kind, str), "metavar": unit}


def _find_option(name: str) -> config.OptionInfo:
    """An option by name; all but those of reading take long to load."""
    if name.startswith("read."):
        from stillmap.prepare.options import ReadOptions

        options = config.iter_options(ReadOptions(), "read.")
    else:
        from stillmap.pipeline.options import DEFAULTS

        options = config.iter_options(DEFAULTS)
    return next(info for info in options if info.name == name)


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
    return config.nest(named)


def options_from_args(args: argparse.Namespace) -> "Options":
    """Resolve options by precedence: default < file < --set < flag.

    Raises:
        InputError: an unknown key or a wrong value, and where it came from.
    """
    from stillmap.pipeline.options import Options

    options = Options()
    if args.config:
        options = config.override(options, config.load_toml(Path(args.config)), args.config)
    given = config.merge_nested(*map(config.parse_assignment, args.assignments))
    options = config.override(options, given, "--set")
    return config.override(options, flag_changes(args))


def read_options(args: argparse.Namespace) -> "ReadOptions":
    """The options of reading; the others take long to load, and are only for --config, --set."""
    from stillmap.prepare.options import ReadOptions

    if getattr(args, "config", None) or getattr(args, "assignments", None):
        return options_from_args(args).read
    return config.override(ReadOptions(), flag_changes(args).get("read", {}))


@contextmanager
def make_parents(output: Path) -> Iterator[None]:
    """Create the parent folders of an output; remove them again if the block fails.

    Raises:
        InputError: they cannot be created, or the output cannot be written there; before anything
            is read.
    """
    from stillmap.core.files import resolve_output, temporary_folder

    parent = resolve_output(output).parent
    created = [folder for folder in (parent, *parent.parents) if not folder.exists()]
    try:
        with explaining_refusal(output):
            parent.mkdir(parents=True, exist_ok=True)
            # the writer reports a device at this path
            if not output.exists() or output.is_file() or output.is_dir():
                with temporary_folder(output):
                    pass
        yield
    except BaseException:
        with suppress(OSError):  # not empty
            for folder in created:
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
