"""Run a notebook and write it as a Markdown page with what its cells show."""

from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

TIMEOUT = 600  # s, of a cell


def render_notebook(path: Path) -> str:
    """The page: text, code and results.

    Raises:
        CellExecutionError: a cell fails.
    """
    notebook = run_notebook(path)
    return "\n\n".join(_render_cell(cell) for cell in notebook.cells) + "\n"


def run_notebook(path: Path) -> Any:
    """Run a notebook in a kernel of this Python.

    Raises:
        CellExecutionError: a cell fails.
    """
    notebook = nbformat.read(path, as_version=4)
    quiet = ["--IPKernelApp.log_level=40"]  # of the transport, which is of this machine alone
    return NotebookClient(notebook, timeout=TIMEOUT, extra_arguments=quiet).execute()


def _render_cell(cell: Any) -> str:
    if cell.cell_type == "markdown":
        return str(cell.source)
    parts = [f"```python\n{cell.source}\n```", *map(_render_output, cell.outputs)]
    return "\n\n".join(parts)


def _render_output(output: Any) -> str:
    """The richest form of an output: a picture, a table, else its text."""
    data = output.get("data", {})
    if "image/png" in data:
        png = "".join(data["image/png"].split())
        return f'<p><img alt="figure" src="data:image/png;base64,{png}"></p>'
    if "text/html" in data:
        lines = (line.strip() for line in data["text/html"].splitlines())
        return f'<div class="notebook-output">{" ".join(lines)}</div>'
    text = output.get("text") or data.get("text/plain", "")
    return f"```text\n{text.rstrip()}\n```"
