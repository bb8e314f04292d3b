"""The command that installs one of stillmap's extras into the environment that runs."""

import json
import os
import shlex
import shutil
import sys
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

_NAME = "stillmap"


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
