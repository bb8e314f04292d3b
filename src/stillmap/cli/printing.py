"""What goes to stdout for machines: one JSON object, alone."""

import json
from pathlib import Path
from typing import Any


def print_json(content: dict[str, Any]) -> None:
    """One object on stdout; numbers that are not finite become null."""
    from stillmap.output.run_json import jsonable

    print(json.dumps(jsonable(content), allow_nan=False))


def files_in(folder: Path) -> list[str]:
    """The files of a folder, with those of its folders, as paths below it."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
