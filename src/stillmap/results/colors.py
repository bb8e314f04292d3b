"""Color maps: (n, 3) uint8 RGB of P(static), heights and ids."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Float, Float32, Index

Colors = NDArray[np.uint8]

Rgb = tuple[int, int, int]

BLUE, ORANGE = (36, 99, 168), (240, 120, 0)  # static, and the robot's trajectory; dynamic
GREY = (205, 205, 205)  # undecided
TEAL = (0, 150, 136)  # rays
BACKGROUND = (236, 238, 241)  # of views in 3D

# at P(static) = 0, 0.5, 1; distinguishable to color-blind readers
_P_STATIC_COLORS = (ORANGE, GREY, BLUE)

# of static points, from low to high: without any shade their shapes could not be told apart
STATIC_COLORS = ((70, 74, 80), (168, 172, 178))

HEIGHT_COLORS = ((40, 53, 90), (45, 96, 130), (60, 140, 132), (122, 178, 106), (214, 196, 96))

# of kinds of changes between sessions, told apart by color-blind readers too
KIND_COLORS = {
    "appeared": (20, 120, 60),
    "gone": (190, 40, 120),
    "moved": (40, 90, 200),
    "door": (150, 92, 0),
}

_HUE_STEP = 0.618034  # of the circle, from one id to the next, so that neighbors differ


def color_by_p_static(p_static: Float32) -> Colors:
    """Orange (dynamic) over grey to blue (static) for P(static) (n,)."""
    return _interpolate_colors(_P_STATIC_COLORS, np.asarray(p_static, np.float64))


def color_by_height(
    z: NDArray[np.floating], low: float, high: float, stops: Sequence[Rgb] = HEIGHT_COLORS
) -> Colors:
    """The first color at `low` to the last one at `high`, for heights z (n,) in m."""
    return _interpolate_colors(stops, (np.asarray(z, np.float64) - low) / max(high - low, 1e-9))


def color_by_id(number: Index | Sequence[int]) -> Colors:
    """A color for each id (n,)."""
    hue = np.mod(np.asarray(number, np.float64) * _HUE_STEP + 0.05, 1.0)
    # a cosine per channel, a third of the circle apart
    level = np.cos(2.0 * np.pi * (hue[:, None] - np.array([0.0, 1.0, 2.0]) / 3.0))
    return np.rint(120.0 + 105.0 * level).astype(np.uint8)


def _interpolate_colors(stops: Sequence[Rgb], share: Float) -> Colors:
    """Linear interpolation between evenly spaced colors over 0 to 1."""
    at = np.linspace(0.0, 1.0, len(stops))
    columns = [np.interp(share, at, column) for column in np.array(stops, np.float64).T]
    colors: Float = np.stack(columns, axis=-1)
    return np.rint(colors).astype(np.uint8)
