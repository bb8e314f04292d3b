"""Imports of the package run downwards: no rooms, folders or modules import in a circle."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MODULES = {
    ".".join(path.relative_to(ROOT / "src").with_suffix("").parts).removesuffix(".__init__"): path
    for path in (ROOT / "src" / "stillmap").rglob("*.py")
}


def imported(module: str, for_types: bool) -> set[str]:
    """Modules of the package that a module imports, anywhere in it, those for types alone too."""
    out, tree = set(), ast.parse(MODULES[module].read_text(encoding="utf-8"))
    if not for_types:
        guarded = [node for node in tree.body if isinstance(node, ast.If)]
        tree.body = [node for node in tree.body if node not in guarded]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            out |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            inside = {f"{node.module}.{name.name}" for name in node.names} & MODULES.keys()
            out |= inside or {node.module}
    return out & MODULES.keys()


def room_of(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def part_of(module: str) -> str:
    """The module, or the folder in a room that holds it."""
    return ".".join(module.split(".")[:3])


def group(key, for_types: bool) -> dict[str, set[str]]:
    """What groups of modules import; the package and the rooms as wholes are left out."""
    graph: dict[str, set[str]] = {}
    for module in MODULES:
        if room_of(module) and not module.endswith(f".{room_of(module)}"):
            graph.setdefault(key(module), set()).update(map(key, imported(module, for_types)))
    return {node: targets - {node} for node, targets in graph.items()}


def find_circle(graph: dict[str, set[str]]) -> list[str]:
    """Nodes that lead to each other; none where there is no circle."""
    rest = dict(graph)
    while rest:
        free = [node for node, targets in rest.items() if not targets & rest.keys()]
        if not free:
            return sorted(rest)
        for node in free:
            del rest[node]
    return []


@pytest.mark.parametrize(("key", "for_types"), [(room_of, True), (part_of, False), (str, False)])
def test_imports_run_downwards(key, for_types):
    assert find_circle(group(key, for_types)) == []


@pytest.mark.parametrize("graph", [{"a": {"b"}, "b": {"a"}}, {"a": {"b"}, "b": {"c"}, "c": {"b"}}])
def test_a_circle_is_found(graph):
    assert "b" in find_circle(graph)
