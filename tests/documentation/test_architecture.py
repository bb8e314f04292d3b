"""The rooms of the package are those of docs/architecture.md, and imports run downwards."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "src" / "stillmap"
MODULES = {
    ".".join(path.relative_to(ROOT / "src").with_suffix("").parts).removesuffix(".__init__"): path
    for path in PACKAGE.rglob("*.py")
}
ROOMS = sorted(path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file())
# constructors of a class, which call what stands above it
UPWARDS = {("stillmap.core.recording", "stillmap.io.from_arrays")}


def imported(module: str) -> set[str]:
    """Modules of the package that a module imports, anywhere in it, for types too."""
    out = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            out |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            inside = {f"{node.module}.{name.name}" for name in node.names} & MODULES.keys()
            out |= inside or {node.module}
    return (out & MODULES.keys()) - {module}


IMPORTS = {
    module: {other for other in imported(module) if (module, other) not in UPWARDS}
    for module in MODULES
}


def room_of(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def part_of(module: str) -> str:
    """The module, or the folder in a room that holds it."""
    return ".".join(module.split(".")[:3])


def listed_rooms() -> list[str]:
    """The rooms in the table of the documentation, from the bottom up."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    table = text.split("## Rooms, bottom to top")[1].split("\n\n")[1]
    return re.findall(r"^\| `(\w+)` \|", table, flags=re.MULTILINE)


def listed_modules(room: str) -> dict[str, int]:
    """Modules and folders of a room, and their row in the table that lists them."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = text.split(f"Modules of `{room}`")[1].split("\n\n")[1].split("\n")[2:]
    names = {k: re.findall(r"`(\w+)/?`", row.split("|")[1]) for k, row in enumerate(rows)}
    return {name: k for k, row in names.items() for name in row}


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


def upward_imports(order: list[str]) -> Iterator[tuple[str, str]]:
    floor = {name: k for k, name in enumerate(order)}
    for module, others in IMPORTS.items():
        for other in others:
            here, there = room_of(module), room_of(other)
            if {here, there} <= floor.keys() and floor[there] > floor[here]:
                yield module, other


def test_every_room_is_listed():
    assert sorted(listed_rooms()) == ROOMS


def test_rooms_import_only_rooms_below_them():
    assert list(upward_imports(listed_rooms())) == []


def test_an_upward_import_is_found():
    assert list(upward_imports(listed_rooms()[::-1]))


def test_modules_do_not_import_each_other():
    assert find_circle(IMPORTS) == []


def test_folders_in_a_room_do_not_import_each_other():
    graph: dict[str, set[str]] = {}
    for module, others in IMPORTS.items():
        parts = {part_of(other) for other in others if room_of(other) == room_of(module)}
        if not module.endswith(f".{room_of(module)}"):  # what a room offers as a whole
            graph.setdefault(part_of(module), set()).update(parts - {part_of(module)})
    assert find_circle(graph) == []


@pytest.mark.parametrize("room", ["places", "fleet", "live"])
def test_modules_of_a_room_are_listed_from_the_bottom_up(room):
    row = listed_modules(room)
    own = {name for name in MODULES if name.startswith(f"stillmap.{room}.")}
    assert row.keys() == {part_of(name).split(".")[2] for name in own}
    for module in own:
        for other in IMPORTS[module] & own:
            here, there = (part_of(name).split(".")[2] for name in (module, other))
            assert row[there] <= row[here], f"{here} imports {there}"


@pytest.mark.parametrize("graph", [{"a": {"b"}, "b": {"a"}}, {"a": {"b"}, "b": {"c"}, "c": {"b"}}])
def test_a_circle_is_found(graph):
    assert "b" in find_circle(graph)
