"""The installed package is complete, and the one under test."""

import ast
import re
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path

import pytest

import stillmap
from stillmap import _core

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def installed():
    """The files of the installed distribution, as they lie below site-packages."""
    try:
        files = distribution("stillmap").files
    except PackageNotFoundError:
        pytest.skip("stillmap is not installed here: run from the source tree")
    return {str(file) for file in files if file.suffix != ".pyc"}


def test_imported_from_the_installation(installed):
    assert "stillmap/__init__.py" in installed
    assert REPOSITORY / "src" not in Path(stillmap.__file__).parents
    assert Path(_core.__file__).parent == Path(stillmap.__file__).parent
    assert stillmap.__version__ == version("stillmap")


def test_every_module_is_installed_and_nothing_else(installed):
    source = REPOSITORY / "src"
    modules = {str(path.relative_to(source)) for path in source.rglob("*.py")}
    own = {file for file in installed if ".dist-info/" not in file}
    assert modules <= own
    kinds = ("report/templates/*.j2", "report/templates/*.js", "worlds/*.toml")
    paths = (path for kind in kinds for path in (source / "stillmap").glob(f"*/{kind}"))
    data = {str(path.relative_to(source)) for path in paths}
    assert data <= own
    assert {"report", "hall"} <= {Path(file).name.partition(".")[0] for file in data}
    script, kernels, *extra = sorted(own - modules - data)
    assert script.endswith("bin/stillmap")
    assert re.fullmatch(r"stillmap/_core\.[\w-]+\.so", kernels)
    assert extra == ["stillmap/_core.pyi", "stillmap/py.typed"]


def parameters(function):
    """Parameter names of a function definition of the stub, with their stars."""
    a = function.args
    names = [p.arg for p in [*a.posonlyargs, *a.args]]
    return tuple(names + (["*"] if a.kwonlyargs else []) + [p.arg for p in a.kwonlyargs])


def functions(body, prefix=""):
    """Name -> parameter names of each overload, for everything that the stub declares."""
    found = {}
    for node in body:
        if isinstance(node, ast.ClassDef):
            found |= functions(node.body, f"{node.name}.")
        elif isinstance(node, ast.FunctionDef):
            is_property = any(getattr(d, "id", "") == "property" for d in node.decorator_list)
            overloads = found.setdefault(prefix + node.name, [])
            overloads.append("property" if is_property else parameters(node))
    return found


def at_run_time(holder, prefix=""):
    """Parameter names of the compiled module."""
    found = {}
    for name, value in vars(holder).items():
        if isinstance(value, type):
            found |= at_run_time(value, f"{name}.")
        elif isinstance(value, property):
            found[prefix + name] = ["property"]
        elif hasattr(value, "__nb_signature__"):
            text = (re.sub(r"\\\d+", "None", s[0]) for s in value.__nb_signature__)
            found[prefix + name] = [
                parameters(ast.parse(re.sub(r"ndarray\[[^\]]*\]", "ndarray", s) + ": ...").body[0])
                for s in text
            ]
    return found


def test_stub_matches_the_kernels():
    path = Path(_core.__file__).with_name("_core.pyi")
    if not path.is_file():
        pytest.skip("no stub beside the compiled module: run from the source tree")
    declared, real = functions(ast.parse(path.read_text()).body), at_run_time(_core)
    assert len(real) > 8
    assert declared == real
