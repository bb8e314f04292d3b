"""MkDocs hooks: pages that lie outside docs/, links between them, and notebooks with their results.

The Markdown files are written for a code host, where links may lead to any file of the repository.
The site has pages only: root pages are added to it, and links are turned to where their target
lies there.
"""

import posixpath
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

sys.path.insert(0, str(Path(__file__).parent))
from notebook_page import render_notebook

ROOT = Path(__file__).resolve().parents[2]
ROOT_PAGES = ("BENCHMARK.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")
LINK = re.compile(r"(\]\()(?!\w+:|#)([^)#\s]+)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the root pages, and a page for each notebook in place of its file."""
    for name in ROOT_PAGES:
        files.append(File.generated(config, name, content=(ROOT / name).read_text("utf-8")))
    for file in [file for file in files if file.src_uri.endswith(".ipynb")]:
        files.remove(file)
        name = file.src_uri.removesuffix(".ipynb") + ".md"
        page = render_notebook(Path(config.docs_dir) / file.src_uri)
        files.append(File.generated(config, name, content=page))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Turn links that hold in the repository into links that hold in the site."""
    here = page.file.src_uri
    folder = posixpath.dirname(here if here in ROOT_PAGES else f"docs/{here}")

    def turn(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, link[2]))
        target = "docs/README.md" if target == "README.md" else target
        if target.startswith("docs/"):
            target = re.sub(r"\.ipynb$", ".md", target.removeprefix("docs/"))
        elif target not in ROOT_PAGES:
            return link[0]
        return link[1] + posixpath.relpath(target, posixpath.dirname(here) or ".")

    return LINK.sub(turn, markdown)
