"""The report's part on places that changed: where they are, and when they did."""

from collections.abc import Sequence
from html import escape

import numpy as np
from PIL import Image

from stillmap.output.crops import Window
from stillmap.output.map_npz import CHANGED, changed_cells
from stillmap.output.protocols import ChangeLike, ResultLike
from stillmap.output.report_figures import map_image, pixel_positions, shown_window
from stillmap.output.report_maps import figure

_MOST_ROWS = 50
_COLOURS = {"came": (20, 120, 60), "left": (190, 40, 120), "comes and goes": (40, 90, 200)}
_TITLES = ("middle, m", "size, m", "cells", "was as before until", "seen otherwise from", "times")


def changes_section(result: ResultLike) -> str:
    """Everything about places that changed; empty where none was found."""
    if not result.changes or not result.map.p_occupied.size:
        return ""
    window = shown_window([result.raw_map, result.map])
    picture = map_image(result.map, window)
    reduced = picture.size[0] < round((window[2] - window[0]) / result.map.resolution)
    marks = _marks(result, window, picture.size)
    listed = _most(result.changes)
    rest = len(result.changes) - len(listed)
    return (
        f"<section><h2>What changed</h2><p>{escape(_summary(result.changes))} {_shown(result)}</p>"
        f"{_key()}"
        + figure(
            "Changes",
            "numbers as in the table",
            [(picture, ""), (marks, "")],
            _numbers(listed, window, picture.size),
            window,
            reduced,
        )
        + _table(listed, int(result.recording.stamp_ns[0]))
        + (f'<p class="soft">{rest} smaller ones are in run.json.</p>' if rest else "")
        + "</section>"
    )


def _shown(result: ResultLike) -> str:
    """What the map has of them."""
    if result.recording.dimension == 3:
        return "The map shows their places as the labels of single voxels have it."
    last = result.options.output.map_state == "last"
    shown = "as it was last seen" if last else "as it was most"
    unless = "" if last else ", unless it was there for most of the time"
    return f"The map shows each {shown}; what comes and goes it shows free{unless}."


def _most(changes: Sequence[ChangeLike]) -> list[ChangeLike]:
    """The largest ones, in their order."""
    largest = sorted(range(len(changes)), key=lambda k: -len(changes[k].cells))[:_MOST_ROWS]
    return [changes[k] for k in sorted(largest)]


def _summary(changes: Sequence[ChangeLike]) -> str:
    kinds = [one.kind for one in changes]
    parts = [
        f"{count} where something {kind}" for kind in CHANGED if (count := kinds.count(kind)) > 0
    ]
    plural = "s" if len(changes) > 1 else ""
    return f"{len(changes)} place{plural} changed: {', '.join(parts)}."


def _key() -> str:
    keys = "".join(
        f'<span class="key" style="background:rgb{colour}"></span>{escape(kind)}'
        for kind, colour in _COLOURS.items()
    )
    return f'<p class="soft">{keys}</p>'


def _marks(result: ResultLike, window: Window, size: tuple[int, int]) -> Image.Image:
    """The cells of all changes in their colours, on nothing, to lie over the map's picture."""
    width, height = size
    pixels = np.zeros((height, width), np.uint8)
    changed = changed_cells(result.map, result.changes)
    row, column = np.nonzero(changed)
    cell = result.map.resolution
    low = np.stack([column, row], axis=1) * cell + np.array(result.map.origin[:2])
    left, bottom = pixel_positions(low, window, size).T
    right, top = pixel_positions(low + cell, window, size).T
    # a cell may be several pixels or a part of one
    steps = max(1, round(width * cell / (window[2] - window[0])))
    for k in range(steps):
        for m in range(steps):
            x = np.floor(left + (k + 0.5) / steps * (right - left)).astype(np.int64)
            y = np.floor(top + (m + 0.5) / steps * (bottom - top)).astype(np.int64)
            inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
            pixels[y[inside], x[inside]] = changed[row[inside], column[inside]]
    image = Image.fromarray(pixels)
    image.putpalette([255, 255, 255, *(v for kind in CHANGED for v in _COLOURS[kind])])
    image.info["transparency"] = 0
    return image


def _numbers(changes: Sequence[ChangeLike], window: Window, size: tuple[int, int]) -> str:
    """The number of each change beside its place."""
    at = np.array([(one.x + one.size[0] / 2, one.y) for one in changes])
    positions = pixel_positions(at, window, size)
    height = max(size) / 60
    texts = "".join(
        f'<text x="{x + height / 4:.1f}" y="{y:.1f}">{k}</text>'
        for k, (x, y) in enumerate(positions.tolist(), 1)
    )
    return (
        f'<svg class="numbers" aria-hidden="true" viewBox="0 0 {size[0]} {size[1]}" '
        f'font-size="{height:.1f}" preserveAspectRatio="none">{texts}</svg>'
    )


def _table(changes: Sequence[ChangeLike], start: int) -> str:
    rows = ""
    for k, one in enumerate(changes, 1):
        cells = (
            f"{one.x:.2f}, {one.y:.2f}" + ("" if one.z is None else f", {one.z:.2f}"),
            " x ".join(f"{metres:.2f}" for metres in one.size),
            f"{len(one.cells):,}",
            _clock(one.before_ns - start),
            _clock(one.stamp_ns - start),
            f"{one.times}",
        )
        rows += f"<tr><th>{k}</th><td>{escape(one.kind)}</td>"
        rows += "".join(f'<td class="number">{cell}</td>' for cell in cells) + "</tr>"
    head = "".join(f'<th class="number">{title}</th>' for title in _TITLES)
    return (
        '<div class="wide"><table><thead><tr><th>number</th><th>what</th>'
        f"{head}</tr></thead><tbody>{rows}</tbody></table></div>"
        '<p class="soft">Hours, minutes and seconds since the first scan.</p>'
    )


def _clock(ns: int) -> str:
    tenths = round(ns / 10**8)
    return f"{tenths // 36000}:{tenths // 600 % 60:02}:{tenths % 600 / 10:04.1f}"
