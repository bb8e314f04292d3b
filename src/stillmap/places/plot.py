"""Layers of the plot of a place: the way of the robot in each session, and changes."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import import_extra
from stillmap.places.pictures import KIND_COLORS
from stillmap.places.records import PlaceSession, SessionChange

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_trajectories(
    poses: NDArray[np.float64], sessions: Iterable[PlaceSession], ax: "Axes"
) -> None:
    """Draw the way of the robot in each accepted session.

    Args:
        poses: (T, D+1, D+1) T_map_base of all scans of the place.
        sessions: of the place.
        ax: axes in metres.
    """
    for one in sessions:
        if one.accepted:
            x, y = poses[one.scans, :2, -1].T
            ax.plot(x, y, linewidth=1.0, label=one.name)


def draw_changes(changes: Iterable[SessionChange], ax: "Axes") -> None:
    """Draw a box around what changed, and an arrow from where it stood before.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    patches = import_extra("matplotlib.patches", "a plot", "drawn", group="notebook")
    for one in changes:
        color = tuple(level / 255.0 for level in KIND_COLORS[one.kind])
        x0, y0, x1, y1 = one.box[:4]
        ax.add_patch(
            patches.Rectangle(
                (x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=color, linewidth=1.2
            )
        )
        if one.from_box is not None:
            before = np.array(one.from_box[:4]).reshape(2, 2).mean(axis=0)
            after = np.array(one.box[:4]).reshape(2, 2).mean(axis=0)
            ax.annotate("", after, before, arrowprops={"arrowstyle": "->", "color": color})
