"""The command that installs one of stillmap's extras into the environment that runs."""

import json
import os
import platform
import shlex
import shutil
import sys
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

_NAME = "stillmap"


def has_wheels(package: str) -> bool:
    """True if a library of an extra is on the package index for this Python and processor.

    The markers in `pyproject.toml` say the same: elsewhere the extra leaves the library out.
    """
    is_common = sys.platform != "linux" or platform.machine() == "x86_64"
    if package == "xatlas":
        return is_common and sys.version_info < (3, 14)
    return package != "pye57" or is_common


def install_hint(package: str, group: str) -> str:
    """How to get a library of an extra."""
    if has_wheels(package):
        return install_command(group)
    here = f"Python {sys.version_info[0]}.{sys.version_info[1]} on {platform.machine()}"
    return f"the extra {group} is without it for {here}; from source: {_pip()} install {package}"


def install_command(group: str) -> str:
    """The pip command that adds an extra to this installation, from where it was installed.

    A package that was installed from a clone or from a wheel is on no index that pip knows:
    `direct_url.json` (PEP 610) says where it came from.

    Args:
        group: name of the extra.
    """
    return f"{_pip()} install {shlex.quote(_requirement(group))}"


def _pip() -> str:
    """`pip` where the shell finds the one of this environment, otherwise with the interpreter."""
    found = shutil.which("pip")
    # not resolved: the interpreters of environments are links to one
    if found and os.path.dirname(found) == os.path.dirname(sys.executable):
        return "pip"
    return f"{shlex.quote(sys.executable)} -m pip"


def _requirement(group: str) -> str:
    url = _origin_url()
    path = Path(url2pathname(urlsplit(url).path)) if url.startswith("file:") else None
    if path is None:
        # from a repository, or from an index
        return f"{_NAME}[{group}] @ {url}" if url else f"{_NAME}[{group}]"
    if not path.exists():
        return f"{_NAME}[{group}]"
    return f"{path}[{group}]" if path.is_dir() else f"{_NAME}[{group}] @ {path.as_uri()}"


def _origin_url() -> str:
    """The source that the package was installed from; empty for an index."""
    from importlib.metadata import PackageNotFoundError, distribution  # only for messages

    try:
        text = distribution(_NAME).read_text("direct_url.json")
    except PackageNotFoundError:  # it runs from the sources
        root = Path(__file__).parents[3]
        return root.as_uri() if (root / "pyproject.toml").is_file() else ""
    if text is None:
        return ""
    record = json.loads(text)
    url, source = str(record["url"]), record.get("vcs_info")
    return url if source is None else f"{source['vcs']}+{url}@{source['commit_id']}"
