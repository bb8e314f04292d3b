"""The likelihood over the iterations (Fig. 5 of the paper) as coordinates of an SVG."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

WIDTH, HEIGHT = 460.0, 260.0  # of the view box
_LEFT, _RIGHT, _TOP, _BOTTOM = 92.0, 12.0, 10.0, 44.0  # margins of the axes
_MAX_TICKS_X = 10


@dataclass(frozen=True)
class Curve:
    """A curve with its axes in view box units, x to the right and y down.

    Attributes:
        box: left, top, right and bottom edge of the axes.
        lines: `points` of the polylines; a value that is not finite ends one.
        dots: positions of the values.
        best: position of the kept iteration; None where its value is not finite.
        x_ticks, y_ticks: positions along the axis, with labels.
    """

    box: tuple[float, float, float, float]
    lines: list[str]
    dots: list[tuple[float, float]]
    best: tuple[float, float] | None
    x_ticks: list[tuple[float, str]]
    y_ticks: list[tuple[float, str]]


def curve_of(numbers: Sequence[int], values: Sequence[float], best: int) -> Curve:
    """Lay out `values` over iteration `numbers`, the same length."""
    box = (_LEFT, _TOP, WIDTH - _RIGHT, HEIGHT - _BOTTOM)
    finite = [v for v in values if math.isfinite(v)] or [0.0]
    low, high = min(finite), max(finite)
    pad = 0.06 * (high - low) or max(1e-3 * abs(high), 1e-3)
    low, high = low - pad, high + pad
    span = max(numbers[-1] - numbers[0], 1)

    def x(number: float) -> float:
        return round(box[0] + 8 + (number - numbers[0]) / span * (box[2] - box[0] - 16), 1)

    def y(value: float) -> float:
        return round(box[3] - (value - low) / (high - low) * (box[3] - box[1]), 1)

    dots, lines = dict[int, tuple[float, float]](), list[list[str]]([[]])
    for number, value in zip(numbers, values, strict=True):
        if math.isfinite(value):
            dots[number] = x(number), y(value)
            lines[-1].append("{},{}".format(*dots[number]))
        else:
            lines.append([])
    every = math.ceil(len(numbers) / _MAX_TICKS_X)
    return Curve(
        box,
        [" ".join(line) for line in lines if len(line) > 1],
        list(dots.values()),
        dots.get(best),
        [(x(number), str(number)) for number in numbers[::every]],
        [(y(value), label) for value, label in _ticks(low, high)],
    )


def round_down(value: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is at most `value` > 0."""
    power = 10.0 ** math.floor(math.log10(value))
    return max((step * power for step in (1, 2, 5) if step * power <= value), default=power)


def _ticks(low: float, high: float) -> list[tuple[float, str]]:
    step = round_down((high - low) / 3)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    first, last = math.ceil(low / step), math.floor(high / step)
    return [(k * step, f"{k * step:,.{digits}f}") for k in range(first, last + 1)]
