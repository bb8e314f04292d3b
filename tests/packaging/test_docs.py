"""Names in the documentation exist: imports of Python blocks, paths of the tree, options."""

import ast
import importlib
import re
import runpy
from pathlib import Path

import pytest

from stillmap.core.config import iter_names
from stillmap.pipeline.options import Options

ROOT = Path(__file__).resolve().parents[2]
# the laboratory quotes commands and names as they were when its figures were measured
PAGES = sorted(
    page
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/**/*.md")]
    if "lab" not in page.relative_to(ROOT).parts
)
SECTIONS = r"(?:em|slam|mesh|read|objects|output)"
pages = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


@pages
def test_imports_of_python_blocks_exist(page):
    for block in re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("stillmap"):
                module = importlib.import_module(node.module)
                for name in node.names:
                    assert hasattr(module, name.name), f"{node.module}.{name.name}"


@pages
def test_paths_exist(page):
    for path in re.findall(r"`((?:src|cpp|tests|benchmarks|docs)/[\w./-]+)`", page.read_text()):
        assert (ROOT / path).exists(), path


@pages
def test_options_exist(page):
    known = set(iter_names(Options()))
    for code in re.findall(r"`([^`\n]+)`", page.read_text()):
        for name in re.findall(rf"(?<![\w./]){SECTIONS}\.[a-z_0-9]+(?![\w(/])", code):
            is_file = name.endswith((".glb", ".json", ".py", ".npy", ".npz", ".obj"))
            assert is_file or name in known, name


def test_options_are_found():
    text = (ROOT / "docs" / "command-line.md").read_text()
    assert "em.prior" in re.findall(rf"{SECTIONS}\.[a-z_]+", text)


def test_table_of_options_is_the_present_one():
    script = runpy.run_path(str(ROOT / "docs" / "site" / "options_page.py"))
    page = (ROOT / "docs" / "options.md").read_text()
    assert page == script["render_page"](), "run: python docs/site/options_page.py"
