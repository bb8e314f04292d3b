"""The argument parser: commands loaded on demand, errors of one line with a hint."""

import argparse
import re
import sys
from collections.abc import Collection, Iterable, Sequence
from importlib import import_module
from itertools import takewhile
from typing import Any, NoReturn

from stillmap.cli.arguments import add_flags
from stillmap.cli.console import colorize
from stillmap.core.errors import closest_match, printable

EXIT_INPUT = 2


class _Help(argparse.HelpFormatter):
    """Wrap paragraphs to the terminal; keep examples as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if "\n" in text:
            return "".join(indent + line for line in text.splitlines(keepends=True))
        return super()._fill_text(text, width, indent)


class Parser(argparse.ArgumentParser):
    """An ArgumentParser whose errors are one line with a suggestion and status 2."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**{"formatter_class": _Help, **settings})

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Refuse unknown flags before missing arguments, which may follow them."""
        words = list(sys.argv[1:] if args is None else args)
        # an empty path is the working directory, which --overwrite would replace
        if any(re.fullmatch(r"(--[^=]+=)?", word) for word in words):
            self.error("an argument is empty", "a variable that is not set?")
        own = takewhile(lambda word: word.startswith("-"), words) if self.subcommands() else words
        self._reject([word for word in _flags(list(own)) if not self._knows(word)])
        found, unknown = super().parse_known_args(words, namespace)
        self._reject(unknown)
        return found, unknown

    def subcommands(self) -> dict[str, "Parser"] | None:
        """Parsers of the commands below this one by name; None: there are none."""
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction):
                return action.choices
        return None

    def flags(self) -> list[str]:
        """All flags, long and short."""
        return [flag for action in self._actions for flag in action.option_strings]

    def error(self, message: str, hint: str = "") -> NoReturn:
        """Print the error on one line and exit."""
        advice = f"{hint} see" if hint else "see"
        line = f"{message} ({advice} {self.prog} --help)".replace("\n", " ")
        name = colorize(f"{self.prog}:", "error", sys.stderr)
        self.exit(EXIT_INPUT, f"{name} {printable(line)}\n")

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """Flush and exit: --help and --version may go into a closed pipe."""
        if sys.stdout is not None:  # None: closed before the start
            sys.stdout.flush()
        super().exit(status, message)

    def _reject(self, unknown: list[str]) -> None:
        if unknown:
            meant = closest_match(unknown[0].partition("=")[0], self.flags())
            hint = f"did you mean '{meant}'?" if meant else ""
            self.error(f"unrecognized arguments: {' '.join(unknown)}", hint)

    def _knows(self, word: str) -> bool:
        """True if a word begins a flag: argparse takes abbreviations too."""
        flag = word.partition("=")[0]
        return any(known.startswith(flag) for known in self.flags())


def _flags(words: list[str]) -> Iterable[str]:
    """The words that can only be long flags."""
    end = min(words.index(stop) if stop in words else len(words) for stop in ("--", "--ros-args"))
    return (word for word in words[:end] if word.startswith("--") and " " not in word)


COMMANDS = {
    "map": "the main job: recording in, folder out",
    "merge": "sessions of one place into one map with dated changes",
    "live": "map scan by scan, as a robot would while it drives",
    "info": "what is in a recording",
    "view": "look at a result",
    "fleet": "many recordings mapped, and merged per place",
    "filter": "the recording without dynamic beams, for other mapping programs",
    "convert": "one recording format to another; results for other programs",
    "simulate": "a recording with truth, for tests and demos",
    "eval": "score a trajectory, labels or a map",
    "config": "every option with its default, unit and meaning, as TOML",
}

_EPILOG = """`stillmap COMMAND --help` shows examples.

exit status:
  0    done
  1    a defect of stillmap
  2    the input or the call is at fault; one line says what to do
  3    fleet: some recordings failed, all others are done
  130  interrupted; nothing is half-written
"""


def parser(wanted: Collection[str] = tuple(COMMANDS)) -> Parser:
    """Build the parser, with the flags and arguments of the commands in `wanted` alone."""
    top = Parser(
        prog="stillmap",
        description="Clean maps of static environments from recordings full of moving objects.",
        epilog=_EPILOG,
    )
    top.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    top.set_defaults(verbose=False, quiet=False)
    commands = top.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, about in COMMANDS.items():
        if name in wanted:
            module = import_module(f"stillmap.cli.{name}")
            text, _, examples = (module.__doc__ or "").partition("\n\n")
            command = commands.add_parser(
                name, help=about, description=" ".join(text.split()), epilog=examples
            )
            add_flags(command, module.FLAGS)
            if hasattr(module, "add_arguments"):
                module.add_arguments(command)
            command.set_defaults(run=module.run)
        else:
            commands.add_parser(name, help=about)
    _add_common(top)
    return top


def parse(words: list[str]) -> argparse.Namespace:
    """Parse a command line without the name of the program; it is kept as `words`."""
    command = next((word for word in words if not word.startswith("-")), "")
    args = parser([command]).parse_args(words)
    args.words = words
    return args


class _Version(argparse.Action):
    """Print the version, looked up on demand."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from stillmap.core.files import package_version

        print(f"stillmap {package_version()}")
        parser.exit()


def _add_common(parser: Parser) -> None:
    """Add -v and --quiet, before the command and after it."""
    if not any(action.dest == "quiet" for action in parser._actions):
        parser.add_argument("--quiet", action="store_true", help="no progress, no summary")
    parser.add_argument("-v", "--verbose", action="store_true", help="print more messages")
    for action in parser._actions:
        if action.dest in ("quiet", "verbose"):
            action.default = argparse.SUPPRESS  # keep the value given before the command
    for command in (parser.subcommands() or {}).values():
        _add_common(command)
