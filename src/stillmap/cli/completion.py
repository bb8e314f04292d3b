"""`stillmap completion SHELL`: the script that lets a shell complete stillmap's command lines."""

import argparse
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NoReturn

from stillmap.cli.parser import COMMANDS, Parser

_EPILOG = """to install it:
  bash  stillmap completion bash > ~/.local/share/bash-completion/completions/stillmap
        (with the package bash-completion), or in ~/.bashrc: eval "$(stillmap completion bash)"
  zsh   in ~/.zshrc, after compinit: eval "$(stillmap completion zsh)"
  fish  stillmap completion fish > ~/.config/fish/completions/stillmap.fish
"""


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    p = commands.add_parser(
        "completion",
        help=COMMANDS["completion"],
        description="Print the script with which a shell completes commands, flags, their choices, "
        "files and folders, and the options of --set. The script asks the installed stillmap, so "
        "it need not be made anew after an update.",
        epilog=_EPILOG,
    )
    p.add_argument("shell", metavar="SHELL", choices=("bash", "zsh", "fish"), help="%(choices)s")
    p.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Prints the script."""
    from argcomplete.shell_integration import shellcode

    print(shellcode(["stillmap"], shell=args.shell))
    return 0


def answer(top: Parser) -> NoReturn:
    """Tells the shell that asks how the line in its environment may go on, and ends the process."""
    import argcomplete

    for action in _actions(top):
        completer = _completer(action)
        if completer is not None and not hasattr(action, "completer"):
            action.completer = completer  # type: ignore[attr-defined]
    argcomplete.autocomplete(top, always_complete_options=False)
    raise SystemExit(1)  # the shell's question has no form that argcomplete knows


def _actions(parser: Parser) -> Iterator[argparse.Action]:
    yield from parser._actions
    for command in (parser.subcommands() or {}).values():
        yield from _actions(command)


def _completer(action: argparse.Action) -> "Callable[..., Iterable[str]] | None":
    """What completes an argument, by what it takes; None: its choices, or any file."""
    from argcomplete.completers import DirectoriesCompleter, FilesCompleter

    shown: Any = action.metavar
    if action.type not in (None, str, Path) or shown in ("TOPIC", "FRAME"):  # no files
        return lambda **_: ()
    if isinstance(shown, str) and shown.endswith("DIR"):
        return DirectoriesCompleter()
    if isinstance(shown, str) and shown.startswith("FILE."):
        return FilesCompleter([shown.removeprefix("FILE.")])
    return None
