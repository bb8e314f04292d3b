"""Write BENCHMARK.md from benchmarks/results/*.csv: one table per question.

    python benchmarks/write_benchmark.py

Each row of a CSV file is one figure: question, case, figure, value, unit, command, commit (at which
the figure was entered), seeds, machine. Files named more_*.csv are listed, not shown.
"""

import argparse
import csv
from itertools import groupby
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGE = ROOT / "BENCHMARK.md"
SHOWN = ("poses", "labels", "models", "quality", "sessions", "live", "cost")
HEAD = """# Benchmarks

`benchmarks/write_benchmark.py` makes this page from `benchmarks/results/*.csv`, which have the
commit of each figure. Machine: {machine}, Debian 12, Python 3.11; compare times within a table
only. `LOGS`: public Radish logs; `DRIVE`: KITTI raw drive 0005; all else is simulated, by seeds
that chose nothing. `--karto-python`, `--kiss-python` and `--peer-python` name the peers' Python.
"""

Row = dict[str, str]


def main() -> None:
    """Write the page."""
    argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0]).parse_args()
    PAGE.write_text(render_page(), encoding="utf-8")


def render_page() -> str:
    """The page as Markdown."""
    rows = [row for name in SHOWN for row in read_rows(RESULTS / f"{name}.csv")]
    machines = " or ".join(unique(rows, "machine"))
    tables = [render_table(question, list(part)) for question, part in by_question(rows)]
    return "\n".join([HEAD.format(machine=machines), *tables, render_list()])


def read_rows(path: Path) -> list[Row]:
    """The figures of a CSV file."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def by_question(rows: list[Row]) -> list[tuple[str, list[Row]]]:
    """Questions in their order, each with its figures."""
    return [(question, list(part)) for question, part in groupby(rows, lambda row: row["question"])]


def unique(rows: list[Row], column: str) -> list[str]:
    """Values of a column in the order in which they come, without empty ones."""
    return [value for value in dict.fromkeys(row[column] for row in rows) if value]


def render_table(question: str, rows: list[Row]) -> str:
    """A heading, the commands, and a table: a line per case, a column per figure."""
    titles = list(dict.fromkeys(title_of(row) for row in rows))
    cells = {(row["case"], title_of(row)): row["value"] for row in rows}
    seeds = ", ".join(unique(rows, "seeds"))
    commands = [f"    {command}" for command in unique(rows, "command")]
    lines = [f"## {question}", "", *commands, ""]
    lines += [f"Seeds: {seeds}.", ""] if seeds else []
    lines += ["| |" + "|".join(titles) + "|", "|---" * (len(titles) + 1) + "|"]
    for case in unique(rows, "case"):
        values = "|".join(cells.get((case, title), "") for title in titles)
        lines.append(f"|{case}|{values}|")
    return "\n".join(lines) + "\n"


def title_of(row: Row) -> str:
    """Heading of a figure's column."""
    return f"{row['figure']}, {row['unit']}" if row["unit"] else row["figure"]


def render_list() -> str:
    """Links to the files that are not shown."""
    names = sorted(path.name for path in RESULTS.glob("more_*.csv"))
    links = ", ".join(f"[{name}](benchmarks/results/{name})" for name in names)
    return f"## Further figures\n\n{links}.\n"


if __name__ == "__main__":
    main()
