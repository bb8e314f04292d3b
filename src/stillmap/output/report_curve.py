"""The likelihood over the iterations (Fig. 5) as inline SVG, in the page's own colours."""

import io
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from stillmap.output.protocols import IterationRecordLike

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# stand-ins that become the page's colours, so that the curve follows its light or dark theme
_INK, _FAINT, _LINE, _MARK = "#010203", "#010204", "#010205", "#010206"
_PAGE_COLOURS = {
    _INK: "var(--ink)",
    _FAINT: "var(--rule)",
    _LINE: "var(--accent)",
    _MARK: "var(--orange)",
}


def likelihood_svg(
    iterations: Sequence[IterationRecordLike], best: int, titles: tuple[str, str]
) -> str:
    """`<svg>` with the expected log likelihood and the bound, the best iteration marked."""
    # matplotlib is slow to load and needed nowhere else
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    numbers = np.array([it.number for it in iterations], float)
    curves = ([it.expected_log_likelihood for it in iterations], [it.bound for it in iterations])
    # a fixed salt makes the element ids, and so the file, repeatable
    style: dict[Any, Any] = {"svg.hashsalt": "stillmap", "svg.fonttype": "none", "font.size": 9.0}
    with matplotlib.rc_context(style):
        figure = Figure(figsize=(9.0, 2.9), layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.subplots(1, 2)
        for axis, title, values in zip(axes, titles, curves, strict=True):
            _draw(axis, title, numbers, np.array(values, float), best)
        buffer = io.StringIO()
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(buffer, format="svg", metadata=nothing)
    return _inline(buffer.getvalue())


def _draw(
    axis: "Axes",
    title: str,
    numbers: np.ndarray,
    values: np.ndarray,
    best: int,
) -> None:
    from matplotlib.ticker import MaxNLocator

    axis.set_title(title, color=_INK, fontsize=9.5, loc="left")
    axis.plot(numbers, values, color=_LINE, linewidth=1.6, marker="o", markersize=3.5)
    chosen = numbers == best
    axis.plot(
        numbers[chosen],
        values[chosen],
        linestyle="none",
        marker="o",
        markersize=9,
        markerfacecolor="none",
        markeredgecolor=_MARK,
        markeredgewidth=2,
    )
    axis.set_xlabel("iteration", color=_INK)
    axis.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axis.ticklabel_format(axis="y", useOffset=False, useMathText=True, scilimits=(-4, 7))
    axis.yaxis.get_offset_text().set_color(_INK)
    axis.tick_params(colors=_INK, which="both")
    axis.grid(color=_FAINT, linewidth=0.7)
    axis.patch.set_visible(False)
    for name, spine in axis.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_color(_FAINT)


def _inline(document: str) -> str:
    """The `<svg>` element alone, without fixed size, foreign addresses or colours of its own."""
    svg = document[document.index("<svg") :]
    svg = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", svg, count=2)
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r"<g id=\"patch_1\">.*?</g>", "", svg, count=1, flags=re.DOTALL)
    for stand_in, colour in _PAGE_COLOURS.items():
        svg = svg.replace(stand_in, colour)
    return svg.replace("<svg", '<svg aria-hidden="true" class="curve"', 1).strip()
