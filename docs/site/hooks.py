"""MkDocs hooks: root pages, the page of options, and links that hold in the repository.

The Markdown files are written for a code host, where links may lead to any file of the repository.
The site has pages only, so links are turned to where their target lies there.
"""

import posixpath
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
ROOT_PAGES = ("BENCHMARK.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")
LINK = re.compile(r"(\]\()(?!\w+:|#)([^)#\s]+)")
OPTIONS = """# Options

What `stillmap config` prints: every option with its default, unit and meaning. Set one with
`--set em.prior=0.8`, or several in the file of `--config options.toml`.

```toml
{}
```
"""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the root pages and the page of options."""
    pages = {name: (ROOT / name).read_text("utf-8") for name in ROOT_PAGES}
    command = [sys.executable, "-m", "stillmap", "config"]
    options = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    pages["options.md"] = OPTIONS.format(options.strip())
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Turn links that hold in the repository into links that hold in the site."""
    here = page.file.src_uri
    folder = posixpath.dirname(here if here in ROOT_PAGES else f"docs/{here}")

    def turn(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, link[2]))
        target = "docs/README.md" if target == "README.md" else target
        if target.startswith("docs/"):
            target = target.removeprefix("docs/")
        elif target not in ROOT_PAGES:
            return link[0]
        return link[1] + posixpath.relpath(target, posixpath.dirname(here) or ".")

    return LINK.sub(turn, markdown)
