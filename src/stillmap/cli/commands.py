"""All commands by name. The module of one is loaded when it is called: that is what takes long."""

import argparse
from collections.abc import Collection
from importlib import import_module

from stillmap.cli.parsing import Parser

COMMANDS = {
    "map": "the main job: recording in, folder out",
    "info": "what is in a recording",
    "view": "look at a result",
    "filter": "the recording again, without beams on what moves, for other mappers",
    "convert": "one recording format to another; results for other programs",
    "simulate": "a recording with truth, for tests and demos",
    "eval": "score a trajectory, labels or a map",
    "config": "every option with its default, unit and meaning, as TOML",
    "completion": "what lets a shell complete commands, flags and options",
}

_EPILOG = """examples:
  stillmap info log.clf.gz              what is in a recording
  stillmap map log.clf.gz -o out        map it
  stillmap view out                     look at the map and the report
  stillmap filter out -o clean.clf      the recording without what moved
  stillmap convert log.bag -o log.mcap  one format to another
  stillmap simulate hall -o sim         a recording with truth
  stillmap eval labels out sim          how good the labels are

exit status:
  0    done
  1    a defect of stillmap
  2    the input or the call is at fault; one line says what to do
  130  interrupted; nothing is half-written
"""


def parser(wanted: Collection[str] = tuple(COMMANDS)) -> Parser:
    """The command line; flags and arguments are there for the commands that are wanted."""
    top = Parser(
        prog="stillmap",
        description="Clean maps of what stands still, from recordings of places full of movers.",
        epilog=_EPILOG,
    )
    top.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    top.set_defaults(verbose=False, quiet=False)
    commands = top.add_subparsers(title="commands", metavar="COMMAND", dest="command")
    for name, about in COMMANDS.items():
        if name in wanted:
            import_module(f"stillmap.cli.{name}").add_parser(commands)
        else:
            commands.add_parser(name, help=about)
    _add_common(top)
    return top


class _Version(argparse.Action):
    """Looked up when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from stillmap import __version__

        print(f"stillmap {__version__}")
        parser.exit()


def _add_common(parser: Parser) -> None:
    """-v and --quiet, before the command and behind it."""
    if not any(action.dest == "quiet" for action in parser._actions):
        parser.add_argument("--quiet", action="store_true", help="no progress, no summary")
    parser.add_argument("-v", "--verbose", action="store_true", help="say more while working")
    for action in parser._actions:
        if action.dest in ("quiet", "verbose"):
            action.default = argparse.SUPPRESS  # not given here: what was said before it stays
    for command in (parser.subcommands() or {}).values():
        _add_common(command)
