"""Libraries that only some formats and models need."""

from importlib import import_module
from typing import Any

from stillmap.errors import InputError


class MissingExtra(InputError):
    """A library is not there: no file at fault, and none that could be skipped for it."""


def extra(module: str, path: object, to_be: str = "read", *, group: str = "io") -> Any:
    """A module that comes with one of stillmap's extras.

    Args:
        module: what to import.
        path: what it is wanted for.
        to_be: what is to be done with it.
        group: the extra.

    Raises:
        MissingExtra: it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        hint = f"pip install 'stillmap[{group}]'"
        raise MissingExtra(f"needs {package} to be {to_be}", where=str(path), hint=hint) from error
