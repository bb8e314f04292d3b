"""Pictures of what a rig built, after Fig. 11 (without texture) and Fig. 12 of the paper."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.rig.build import TiltingResult
from stillmap.sim import RigSimulation
from stillmap.tracking import MovingObject

Float = NDArray[np.float64]

_HIGHEST = 2.6  # m; the ceiling would hide everything
_AROUND = 1.5  # m around an object that are shown with it
_NOD = 2.0  # s, up or down
_SHOWN = 6  # objects
_ENOUGH = 100  # points, from which on a picture is none the better for more


def draw(folder: Path, world: str, rig: RigSimulation, built: TiltingResult) -> None:
    """Write `WORLD-fig11.png` and `WORLD-fig12.png`.

    Args:
        folder: is made where there is none.
        world: its name.
        rig: what was simulated.
        built: what came of it.
    """
    import matplotlib

    matplotlib.use("Agg")
    folder.mkdir(parents=True, exist_ok=True)
    hits = np.flatnonzero(built.deskewed.hit)
    ends = built.deskewed.end_points(hits, built.poses)
    below = ends[:, 2] < _HIGHEST
    hits, ends = hits[below], ends[below]
    seconds = (
        1e-9 * (built.deskewed.stamp_ns - built.deskewed.stamp_ns[0])[built.deskewed.scans_of(hits)]
    )
    _fig11(folder / f"{world}-fig11.png", ends, built.p_static[hits] < 0.5)
    number = np.full(built.deskewed.n_beams, -1)
    number[hits] = np.arange(len(hits))
    _fig12(folder / f"{world}-fig12.png", ends, seconds, number, built)
    dynamic = ~rig.tilting.truth.static[hits]
    print(f"{world}: {len(hits)} points below {_HIGHEST} m, {dynamic.sum()} of them on movers")


def _fig11(path: Path, ends: Float, moves: NDArray[np.bool_]) -> None:
    """All points above, those that are kept below; coloured by height."""
    from matplotlib import pyplot as plt

    figure = plt.figure(figsize=(14, 13))
    for k, (title, some) in enumerate(
        (("all points", np.ones(len(ends), bool)), ("what stands still", ~moves))
    ):
        axes: Any = figure.add_subplot(2, 1, k + 1, projection="3d")
        x, y, z = ends[some].T
        axes.scatter(x, y, z, c=z, s=0.3, cmap="viridis", linewidths=0, vmin=0, vmax=_HIGHEST)
        if k == 0:
            axes.scatter(*ends[moves].T, c="crimson", s=1.0, linewidths=0)
        axes.view_init(elev=35, azim=-80)
        low, high = np.percentile(ends, [0.2, 99.8], axis=0)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.set_box_aspect(high - low, zoom=1.6)
        axes.set_axis_off()
        axes.set_title(f"{title}: {some.sum()}")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _fig12(
    path: Path, ends: Float, seconds: Float, at: NDArray[np.int64], built: TiltingResult
) -> None:
    """Objects, each within one nod and without its motion meanwhile, black; what stays, grey."""
    from matplotlib import pyplot as plt

    figure = plt.figure(figsize=(15, 10))
    stays = ends[built.p_static[np.flatnonzero(at >= 0)] >= 0.5]
    shown = [(one, *_moment(one, ends, seconds, at, built)) for one in built.objects]
    shown = [row for row in shown if len(row[1])]
    shown.sort(key=lambda row: -min(len(row[1]), _ENOUGH) * np.ptp(row[1][:, 2]))
    for k, (one, own, when) in enumerate(shown[:_SHOWN]):
        middle = own.mean(axis=0)
        near = stays[np.abs(stays[:, :2] - middle[:2]).max(axis=1) < _AROUND]
        axes: Any = figure.add_subplot(2, 3, k + 1, projection="3d")
        axes.scatter(*near.T, c="0.5", s=2.5, linewidths=0, alpha=0.6)
        axes.scatter(*own.T, c="black", s=9, linewidths=0)
        away = middle[:2] - _place(built, when)  # seen from where the robot was
        axes.view_init(elev=12, azim=np.degrees(np.arctan2(-away[1], -away[0])))
        axes.set_box_aspect(np.ptp(np.concatenate([near, own]), axis=0), zoom=1.4)
        axes.set_title(f"object {one.id}: {len(own)} points, {one.size[2]:.2f} m tall")
        axes.set_axis_off()
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _moment(
    one: MovingObject, ends: Float, seconds: Float, at: NDArray[np.int64], built: TiltingResult
) -> tuple[Float, float]:
    """Points (n, 3) of an object in the nod that has most, where they were then, and when."""
    own = at[one.beams]
    own = own[own >= 0]
    t = seconds[own]
    within = np.searchsorted(t, t + _NOD) - np.arange(len(t))
    first = int(within.argmax()) if len(t) else 0
    own, t = own[first : first + within[first]], t[first : first + within[first]]
    when = float(t.mean())
    track = 1e-9 * (one.stamp_ns - built.deskewed.stamp_ns[0])
    xyz = ends[own].copy()
    for k in range(2):
        xyz[:, k] += np.interp(when, track, one.xy[:, k]) - np.interp(t, track, one.xy[:, k])
    return xyz, when


def _place(built: TiltingResult, when: float) -> Float:
    """x, y of the robot."""
    t = 1e-9 * (built.deskewed.stamp_ns - built.deskewed.stamp_ns[0])
    return np.asarray(built.poses[min(int(np.searchsorted(t, when)), len(t) - 1), :2, 3])
