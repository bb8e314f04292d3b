"""Links of the documentation resolve, and BENCHMARK.md is what its script makes of the figures."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
GENERATED = {ROOT / "docs" / "options.md"}
LINK = re.compile(r"\]\((?!\w+:)([^)#\s]*)(?:#([^)\s]+))?\)")


def anchors_of(page):
    """Anchors of the headings of a page, as code hosts and MkDocs make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)
    titles = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", t.lower())).strip("-") for t in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_resolve(page):
    broken = []
    for path, anchor in LINK.findall(page.read_text("utf-8")):
        target = (page.parent / path).resolve() if path else page
        if not target.exists() and target not in GENERATED:
            broken.append(path)
        elif anchor and anchor not in anchors_of(target):
            broken.append(f"{path}#{anchor}")
    assert broken == []


def test_benchmark_is_made_from_the_figures():
    script = runpy.run_path(str(ROOT / "benchmarks" / "write_benchmark.py"))
    page = (ROOT / "BENCHMARK.md").read_text("utf-8")
    assert page == script["render_page"](), "run: python benchmarks/write_benchmark.py"


def test_every_figure_has_its_command_commit_and_machine():
    script = runpy.run_path(str(ROOT / "benchmarks" / "write_benchmark.py"))
    for path in sorted((ROOT / "benchmarks" / "results").glob("*.csv")):
        for row in script["read_rows"](path):
            needed = ("question", "case", "figure", "value", "command", "commit", "machine")
            assert all(row[column] for column in needed), (path.name, row)
