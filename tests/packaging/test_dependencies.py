"""Every library that the package imports is a declared dependency, in the right group."""

import ast
import re
import sys
import tomllib
from functools import cache
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "src" / "stillmap"
# modules that are imported only where their extra is in use
NEEDS_EXTRA = {
    "results/viewer/server.py": "viewer",
    "live/foxglove_server.py": "live",
    # for type checkers alone
    **{f"results/{name}.py": "notebook" for name in ("plot", "result", "tables")},
}
SINCE_PYTHON_3_14 = {"compression"}  # the standard library's zstd; before, backports.zstd


@cache
def packages_distributions():
    """Names of the distributions by top-level module, those of a single extension module too."""
    found = dict(metadata.packages_distributions())
    for one in metadata.distributions():
        found.setdefault(one.name, [one.name])
    return found


def normalized(requirement):
    """The distribution a requirement names, as PEP 503 spells it."""
    return re.sub(r"[-_.]+", "-", re.match(r"[\w.-]+", requirement)[0]).lower()


@pytest.fixture(scope="module")
def declared():
    """Names of the distributions of each group; "" is the base installation."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    groups = {"": project["dependencies"], **project["optional-dependencies"]}
    return {
        name: {normalized(one) for one in requirements if not one.startswith("stillmap[")}
        for name, requirements in groups.items()
    }


def imports(path):
    """(module, group) of what a file imports; group "" where nothing else is said."""
    default = NEEDS_EXTRA.get(str(path.relative_to(PACKAGE)), "")
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from ((name.name, default) for name in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from ((f"{node.module}.{name.name}", default) for name in node.names)
        elif isinstance(node, ast.Call) and re.search(
            r"import_(extra|module)$", ast.unparse(node.func)
        ):
            group = next((k.value.value for k in node.keywords if k.arg == "group"), "io")
            if isinstance(node.args[0], ast.Constant):
                yield node.args[0].value, group


def is_foreign(module):
    top = module.partition(".")[0]
    return top != "stillmap" and top not in sys.stdlib_module_names | SINCE_PYTHON_3_14


FOREIGN = sorted(
    {
        (module, group, str(path.relative_to(PACKAGE)))
        for path in PACKAGE.rglob("*.py")
        if not path.is_relative_to(PACKAGE / "live" / "ros")  # the user's own ROS
        for module, group in imports(path)
        if is_foreign(module)
    }
)


def distributions_of(module):
    """Names of the installed distributions that provide a module."""
    top, _, rest = module.partition(".")
    # one that is not installed, as there are no wheels here, has the name of its module
    found = [normalized(name) for name in packages_distributions().get(top, [top])]
    # a namespace such as `backports` belongs to several
    exact = normalized(f"{top}.{rest.partition('.')[0]}")
    return [exact] if exact in found else found


def test_every_import_is_declared(declared):
    missing = [
        f"{file}: {module} ({', '.join(found) or 'not installed'})"
        for module, group, file in FOREIGN
        if not set(found := distributions_of(module)) & (declared[""] | declared.get(group, set()))
    ]
    assert missing == []


def test_every_declared_library_is_used(declared):
    text = "\n".join(path.read_text() for path in PACKAGE.rglob("*.py"))
    modules = {}
    for top, names in packages_distributions().items():
        for name in names:
            modules.setdefault(normalized(name), set()).add(top)
    unused = [
        name
        for group in ("", "io", "live", "mesh", "viewer")
        for name in declared[group]
        if not any(re.search(rf"\b{re.escape(top)}\b", text) for top in modules.get(name, ()))
    ]
    assert unused == []
