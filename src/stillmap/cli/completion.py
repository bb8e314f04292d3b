"""`stillmap completion SHELL`: print the completion script of a shell."""

import argparse
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NoReturn

from stillmap.cli.parser import Parser

DESCRIPTION = (
    "Print the script with which a shell completes commands, flags, their choices, "
    "files and folders, and the options of --set. It asks the installed stillmap and stays "
    "valid after an update."
)
EPILOG = """to install it:
  bash  stillmap completion bash > ~/.local/share/bash-completion/completions/stillmap
        (with the package bash-completion), or in ~/.bashrc: eval "$(stillmap completion bash)"
  zsh   in ~/.zshrc, after compinit: eval "$(stillmap completion zsh)"
  fish  stillmap completion fish > ~/.config/fish/completions/stillmap.fish
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the flags and arguments."""
    p.add_argument("shell", metavar="SHELL", choices=("bash", "zsh", "fish"), help="%(choices)s")


def run(args: argparse.Namespace) -> int:
    """Print the script."""
    from argcomplete.shell_integration import shellcode

    print(shellcode(["stillmap"], shell=args.shell))
    return 0


def answer_shell(top: Parser) -> NoReturn:
    """Print the completions of the command line in the environment, and exit."""
    import argcomplete

    for action in _iter_actions(top):
        completer = _find_completer(action)
        if completer is not None and not hasattr(action, "completer"):
            action.completer = completer  # type: ignore[attr-defined]
    argcomplete.autocomplete(top, always_complete_options=False)
    raise SystemExit(1)  # argcomplete does not know this form of request


def _iter_actions(parser: Parser) -> Iterator[argparse.Action]:
    yield from parser._actions
    for command in (parser.subcommands() or {}).values():
        yield from _iter_actions(command)


def _find_completer(action: argparse.Action) -> "Callable[..., Iterable[str]] | None":
    """The completer of an argument by its type; None: its choices, or any file."""
    from argcomplete.completers import DirectoriesCompleter, FilesCompleter

    shown: Any = action.metavar
    if action.type not in (None, str, Path) or shown in ("TOPIC", "FRAME"):  # no files
        return lambda **_: ()
    if isinstance(shown, str) and shown.endswith("DIR"):
        return DirectoriesCompleter()
    if isinstance(shown, str) and shown.startswith("FILE."):
        return FilesCompleter([shown.removeprefix("FILE.")])
    return None
