"""What stillmap needs at run time, with its extras and what those need, as it is installed here.

    python tools/supply.py licenses      # a table; fails on what is unknown or not permissive
    python tools/supply.py constraints   # the content of constraints.txt

Licenses are those that the packages state. Run by `make check` in the environment of the tests,
which has all extras.
"""

import re
import sys
import tomllib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
RUNTIME = ("io", "mesh", "viewer", "notebook", "live", "fleet", "s3")

PERMISSIVE = {
    *("MIT", "MIT-0", "MIT-CMU", "BSD", "BSD-2-Clause", "BSD-3-Clause", "0BSD", "Apache-2.0"),
    *("PSF-2.0", "Zlib", "CC0-1.0", "HPND", "ISC", "Unlicense"),
}
# as packages spell them without SPDX
NAMES = {
    "apache software license": "Apache-2.0",
    "apache 2.0": "Apache-2.0",
    "bsd license": "BSD",
    "bsd 3-clause license": "BSD-3-Clause",
    "simplified bsd license": "BSD-2-Clause",
    "isc license (iscl)": "ISC",
    "mit license": "MIT",
    "python software foundation license": "PSF-2.0",
    **{name.lower(): name for name in PERMISSIVE},
}
# stated otherwise, looked at: what is stated, and why that is fine
REVIEWED = {
    "apsw": ("any-OSI", "its author grants any license that the OSI approves"),
    "certifi": ("MPL-2.0", "a list of certificates, used as it is; MPL covers its files alone"),
    "tqdm": ("MPL-2.0 AND MIT", "used as it is; MPL covers its files alone"),
}


def normalize(name: str) -> str:
    """The name of a package as PEP 503 spells it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def find_dependencies(groups: tuple[str, ...]) -> list[str]:
    """Sorted names of all packages that stillmap and some of its extras need on this machine."""
    found: dict[str, set[str]] = {}
    roots = [*PROJECT["dependencies"]]
    for group in groups:
        roots += PROJECT["optional-dependencies"][group]
    for text in roots:
        _add(text, {""}, found)
    return sorted(found)


def _add(text: str, extras: set[str], found: dict[str, set[str]]) -> None:
    """Add a requirement of a package that is used with some extras, and what it needs itself."""
    one = Requirement(text)
    if one.marker and not any(one.marker.evaluate({"extra": extra}) for extra in extras):
        return
    name = normalize(one.name)
    if name == "stillmap":
        for group in one.extras:
            for needed in PROJECT["optional-dependencies"][group]:
                _add(needed, {""}, found)
        return
    used = found.setdefault(name, set())
    new = ({""} | one.extras) - used
    used |= new
    for needed in _requires(name) if new else ():
        _add(needed, new, found)


def _requires(name: str) -> list[str]:
    try:
        return metadata.requires(name) or []
    except metadata.PackageNotFoundError:
        return []


def stated_license(name: str) -> str:
    """What a package says its license is: an SPDX expression, or else what it has; "" for none."""
    try:
        about = metadata.metadata(name)
    except metadata.PackageNotFoundError:
        return ""
    if about.get("License-Expression"):
        return str(about["License-Expression"])
    kinds = [one.split(" :: ") for one in about.get_all("Classifier") or []]
    classified = [kind[-1] for kind in kinds if kind[0] == "License" and len(kind) > 1]
    text = str(about.get("License") or "").strip()
    # some have the whole text there, below its name
    stated = [text.partition("\n")[0].strip(), " OR ".join(classified)]
    return next(filter(is_permissive, stated), next(filter(None, stated), ""))


def is_permissive(expression: str) -> bool:
    """True if every part of an expression is permissive, or one of each choice."""
    if not expression:
        return False
    parts = re.split(r"\s+AND\s+", expression)
    return all(
        any(
            NAMES.get(one.strip("() ").lower()) in PERMISSIVE for one in re.split(r"\s+OR\s+", part)
        )
        for part in parts
    )


def check_licenses(names: list[str]) -> Iterator[tuple[str, str, str]]:
    """Name, stated license and fault of each package; the fault is empty where there is none."""
    for name in names:
        stated = stated_license(name)
        reviewed, _ = REVIEWED.get(name, ("", ""))
        if not stated:
            yield name, "", "unknown, or not installed"
        elif is_permissive(stated) or (reviewed and stated.startswith(reviewed)):
            yield name, stated, ""
        else:
            yield name, stated, "not known to be permissive"


def _print_licenses() -> int:
    rows = list(check_licenses(find_dependencies(RUNTIME)))
    for name, stated, fault in rows:
        print(f"{name:<24}{stated}{f'  <- {fault}' if fault else ''}")
    faults = sum(bool(fault) for *_, fault in rows)
    print(f"{len(rows)} packages, {faults} at fault")
    return min(faults, 1)


def _print_constraints() -> int:
    python = f"{sys.version_info[0]}.{sys.version_info[1]}"
    print(f"# Versions that the tests passed with, on Python {python}: tools/supply.py constraints")
    for name in find_dependencies((*RUNTIME, "test")):
        print(f"{name}=={metadata.version(name)}")
    return 0


if __name__ == "__main__":
    COMMANDS = {"licenses": _print_licenses, "constraints": _print_constraints}
    sys.exit(COMMANDS[sys.argv[1]]())
