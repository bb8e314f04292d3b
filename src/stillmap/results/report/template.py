"""Pages rendered from the Jinja2 templates beside, and numbers as text: their filters."""

import base64
import functools
import hashlib
import math
import os
import sys
from collections.abc import Iterable, Mapping
from importlib.util import cache_from_source
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.core.files import package_version

if TYPE_CHECKING:
    from jinja2 import BytecodeCache, Environment

_TEMPLATES = Path(__file__).parent / "templates"


def render_page(data: Mapping[str, Any], template: str = "report.html.j2") -> str:
    """A page: no outside request, images and script inline."""
    script = (_TEMPLATES / "map_view.js").read_text(encoding="utf-8")
    # without its hash, browsers run no script of the page
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    known = {"result": None, "place": None, "script": script, "script_hash": digest}
    return render(template, **{**known, **data, "version": package_version()})


def render(template: str, **data: Any) -> str:
    """The text of a template."""
    return _environment().get_template(template).render(data)


def render_part(template: str, macro: str, *arguments: Any) -> str:
    """The text of a macro of a template; a plain one, as viser sends no other kinds."""
    return str(getattr(_environment().get_template(template).module, macro)(*arguments))


@functools.cache
def _environment() -> "Environment":
    """The templates with the filters below; HTML in data is escaped."""
    # jinja2 is loaded only where a report is written
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        bytecode_cache=_bytecode_cache(),
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(FILTERS)
    return environment


def _bytecode_cache() -> "BytecodeCache | None":
    """Compiled templates, kept where Python keeps its modules; None: Python keeps none either.

    Compiling takes longer than rendering.
    """
    if sys.dont_write_bytecode:
        return None
    from jinja2 import FileSystemBytecodeCache

    folder = Path(cache_from_source(str(_TEMPLATES / "report.py"))).parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return FileSystemBytecodeCache(str(folder)) if os.access(folder, os.W_OK) else None


def format_share(share: float) -> str:
    """A share in percent, with one decimal or two significant digits."""
    percent = 100 * share
    if not math.isfinite(percent):
        return "unknown"
    return f"{percent:.1f} %" if percent >= 1 or percent == 0 else f"{percent:.2g} %"


def format_duration(seconds: float) -> str:
    """Seconds as ms, s, min or h."""
    if 0 < seconds < 0.0995:  # more would be 1e+02 ms
        return f"{1e3 * seconds:.2g} ms"
    if seconds < 10:
        return f"{seconds:.2g} s"
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def format_bytes(size: float) -> str:
    """A number of bytes in MB or GB (powers of ten)."""
    if not size:
        return "unknown"
    return f"{size / 1e6:,.0f} MB" if size < 1e9 else f"{size / 1e9:.2f} GB"


def format_number(value: float | None) -> str:
    """A number with seven significant digits; a dash for None and for what is not finite."""
    return "-" if value is None or not math.isfinite(value) else f"{value:,.7g}"


def format_clock(ns: int) -> str:
    """Nanoseconds as hours:minutes:seconds with tenths."""
    tenths = round(ns / 10**8)
    return f"{tenths // 36000}:{tenths // 600 % 60:02}:{tenths % 600 / 10:04.1f}"


def format_scalar(value: object) -> str:
    """A JSON scalar."""
    if value is None:
        return "not set"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.7g}" if isinstance(value, float) else str(value)


def format_lengths(values: Iterable[float | None], separator: str = ", ") -> str:
    """Lengths with two decimals, those that are not None."""
    return separator.join(f"{value:.2f}" for value in values if value is not None)


def format_sentence(text: str) -> str:
    """A text with a full stop; the style sheet shows its first letter as a capital."""
    return text + "." * (text[-1:] not in ".?!")


FILTERS = {
    "share": format_share,
    "duration": format_duration,
    "bytes": format_bytes,
    "number": format_number,
    "clock": format_clock,
    "scalar": format_scalar,
    "lengths": format_lengths,
    "sentence": format_sentence,
    "comma": "{:,}".format,
}
