"""Write docs/options.md, the table of all options, from the options themselves.

python docs/site/options_page.py
"""

from itertools import groupby
from pathlib import Path

from stillmap.core.config import OptionInfo, iter_options
from stillmap.pipeline.options import Options

PAGE = Path(__file__).resolve().parents[1] / "options.md"
HEAD = """# Options

Every option of `stillmap map`, as `stillmap config` prints them. Set one with
`--set em.prior=0.8`, or several in the file of `--config options.toml`; some have a flag of
their own ([command line](command-line.md#options)). In Python: `Options`
([API](api/mapping.md)). SI units; angles are radians.

*`docs/site/options_page.py` writes this page.*
"""
TITLES = {
    "": "General",
    "read": "Reading a recording",
    "em": "Static or dynamic: the EM loop",
    "slam": "Poses and map",
    "slam.odometry": "Noise of wheel odometry",
    "objects": "Moving objects",
    "mesh": "Models of 3D recordings",
    "output": "Result folder",
}


def main() -> None:
    """Write the page."""
    PAGE.write_text(render_page(), encoding="utf-8")


def render_page() -> str:
    """The page as Markdown."""
    sections = groupby(iter_options(Options()), lambda one: one.name.rpartition(".")[0])
    return HEAD + "".join(_render_section(name, list(options)) for name, options in sections)


def _render_section(name: str, options: list[OptionInfo]) -> str:
    rows = "".join(_render_row(one) for one in options)
    title = TITLES[name] + (f": `{name}`" if name else "")
    return f"\n## {title}\n\n| option | default | meaning | values |\n|---|---|---|---|\n{rows}"


def _render_row(one: OptionInfo) -> str:
    default = "not set" if one.default is None else f"`{_as_toml(one.default)}`"
    choices = ", ".join(f"`{choice}`" for choice in one.choices)
    values = choices or str(one.limits) or one.kind.split(" or ")[0]
    cells = (f"`{one.name}`", default, one.doc, values)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


def _as_toml(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


if __name__ == "__main__":
    main()
