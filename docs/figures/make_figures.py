"""Draw the figures of e-step-in-ten-minutes.md from a simulated recording.

    python docs/figures/make_figures.py

Needs stillmap and matplotlib; about a minute on one core. Nothing is read from disk: the recording
is simulated with a fixed seed, so the figures can be drawn again at any time.
"""

from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt

import stillmap
from stillmap.sim import scene_by_name, simulate

HERE = Path(__file__).parent
SEED = 100
SCANS = 1200
BIN = 0.5  # s, length of one observation
CELL = 0.10  # m, edge of the cells of the timeline figure
BEHIND = 0.3  # m, how far behind a cell a beam must end to have passed through it
DETECTION = 0.97  # a, P(hit | occupied)
STATIC = (0.998, 100.0)  # rho, tau in s of a wall
PASSING = (0.04, 3.0)  # rho, tau in s of a place where people come and go
SHARE_STATIC = 0.8  # s, share of the static class among all cells
ORANGE, BLUE, GREY = "#d95f02", "#1f6fb4", "#9aa0a6"


def filter_forward(
    times: np.ndarray, hits: np.ndarray, rho: float, tau: float
) -> tuple[np.ndarray, np.ndarray]:
    """Run the forward filter of one cell.

    Args:
        times: (K,) s, when the cell was observed.
        hits: (K,) bool, True for a hit, False for a miss.
        rho: stationary probability of being occupied.
        tau: s, correlation time.

    Returns:
        (K,) P(occupied | observations so far) and (K,) log likelihood of the observations so far.
    """
    p, log_w, before = rho, 0.0, times[0]
    occupied, log_likelihood = [], []
    for t, hit in zip(times, hits, strict=True):
        p = rho + (p - rho) * np.exp(-(t - before) / tau)  # predict
        evidence = DETECTION * p if hit else 1.0 - DETECTION * p
        p = 1.0 if hit else p * (1.0 - DETECTION) / evidence  # update
        log_w += np.log(evidence)
        before = t
        occupied.append(p)
        log_likelihood.append(log_w)
    return np.array(occupied), np.array(log_likelihood)


def observe(result: stillmap.Result, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times (K,) in s and hits (K,) bool of the time bins in which beams observed a cell."""
    recording, poses = result.deskewed, result.poses
    seconds = (recording.stamp_ns - recording.stamp_ns[0]) * 1e-9
    sensors = recording.T_map_sensor(poses)
    hit_in_bin: dict[int, bool] = {}
    for t in range(recording.n_scans):
        beams = recording.beams_of(t)
        hit = recording.hit[beams]
        ends = recording.points[beams][hit] @ sensors[t, :2, :2].T + sensors[t, :2, 2]
        way = ends - sensors[t, :2, 2]
        length = np.linalg.norm(way, axis=1)
        direction = way / length[:, None]
        off = centre - sensors[t, :2, 2]
        along = direction @ off
        aside = np.abs(direction[:, 0] * off[1] - direction[:, 1] * off[0])
        ended = (np.abs(ends - centre) <= CELL / 2).all(axis=1).any()
        passed = ((along > 0) & (aside < CELL / 2) & (length > along + BEHIND)).any()
        if ended or passed:
            number = int(seconds[t] / BIN)
            hit_in_bin[number] = hit_in_bin.get(number, False) or bool(ended)
    numbers = sorted(hit_in_bin)
    return BIN * np.array(numbers), np.array([hit_in_bin[k] for k in numbers])


def end_points(result: stillmap.Result) -> np.ndarray:
    """End points (M, 2) of all beams in the map frame, in metres."""
    recording = result.deskewed
    sensors = recording.T_map_sensor(result.poses)
    scan = np.repeat(np.arange(recording.n_scans), np.diff(recording.offset))
    turned = np.einsum("nij,nj->ni", sensors[scan, :2, :2], recording.points)
    return turned + sensors[scan, :2, 2]


def choose_cells(result: stillmap.Result) -> tuple[np.ndarray, np.ndarray]:
    """Centres of a wall cell and of a cell in which somebody stood when it was first observed."""
    ends, hit = end_points(result), result.deskewed.hit
    chosen = []
    for dynamic in (False, True):
        mask = hit & (result.p_static < 0.1 if dynamic else result.p_static > 0.99)
        cells, counts = np.unique(np.floor(ends[mask] / CELL), axis=0, return_counts=True)
        some = cells[np.argsort(counts)[::-1][: 300 if dynamic else 40]]
        centres = (some + 0.5) * CELL
        scores = [_interest(*observe(result, centre), dynamic) for centre in centres]
        chosen.append(centres[int(np.argmax(scores))])
    return chosen[0], chosen[1]


def _interest(times: np.ndarray, hits: np.ndarray, dynamic: bool) -> float:
    """How well a cell shows what its kind looks like: many observations, few or early hits."""
    first_miss = int(np.argmin(hits)) if not hits.all() else len(hits)
    if dynamic:
        return float(min(first_miss, 10) * min(len(hits) - hits.sum(), 10) * np.ptp(times))
    return float(hits.sum() * np.ptp(times) * (hits.mean() > 0.9))


def draw_maps(result: stillmap.Result) -> None:
    """Raw map beside clean map, within the bounds of what stands still."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained", sharey=True)
    static = end_points(result)[result.deskewed.hit & (result.p_static > 0.5)]
    low, high = static.min(axis=0) - 1, static.max(axis=0) + 1
    maps = (result.raw_map, result.map)
    titles = ("every hit counted as static", "hits weighted by P(static)")
    for axis, grid, title in zip(axes, maps, titles, strict=True):
        height, width = grid.p_occupied.shape
        x, y, r = grid.origin[0], grid.origin[1], grid.resolution
        # a walker leaves a few per cent in a cell: the gamma shows them
        ink = np.nan_to_num(grid.p_occupied, nan=0.0).clip(0, 1) ** 0.4
        shown = np.where(np.isfinite(grid.p_occupied), 1.0 - ink, 0.85)
        axis.imshow(
            shown,
            origin="lower",
            extent=(x, x + width * r, y, y + height * r),
            cmap="gray",
            vmin=0,
            vmax=1,
            interpolation="antialiased",
        )
        axis.set_facecolor("0.85")
        axis.set_xlim(low[0], high[0])
        axis.set_ylim(low[1], high[1])
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("x, m", fontsize=8)
        axis.tick_params(labelsize=7)
    axes[0].set_ylabel("y, m", fontsize=8)
    figure.savefig(HERE / "raw-and-clean.png", dpi=100)
    plt.close(figure)


def draw_timeline(result: stillmap.Result) -> None:
    """Observations, filter and posterior of a wall cell and of a cell on the floor."""
    figure, axes = plt.subplots(
        3,
        2,
        figsize=(9, 4.6),
        layout="constrained",
        sharex="col",
        gridspec_kw={"height_ratios": (0.6, 1, 1)},
    )
    titles = ("a cell of a wall", "a free cell, occupied by a person for a while")
    for column, centre, title in zip(axes.T, choose_cells(result), titles, strict=True):
        times, hits = observe(result, centre)
        _draw_cell(column, times, hits)
        column[0].set_title(title, fontsize=10)
        column[2].set_xlabel("time, s", fontsize=8)
    for axis, label in zip(axes[:, 0], ("", "P(occupied)", "P(static)"), strict=True):
        axis.set_ylabel(label, fontsize=9)
    axes[1, 1].legend(fontsize=7, loc="center right")
    figure.savefig(HERE / "cell-timeline.png", dpi=110)
    plt.close(figure)


def _draw_cell(axes: np.ndarray, times: np.ndarray, hits: np.ndarray) -> None:
    axes[0].eventplot(
        [times[~hits], times[hits]],
        colors=[BLUE, ORANGE],
        lineoffsets=[0, 1],
        linelengths=0.8,
        linewidths=1.0,
    )
    axes[0].set_yticks([0, 1], ["miss", "hit"])
    static, log_static = filter_forward(times, hits, *STATIC)
    passing, log_passing = filter_forward(times, hits, *PASSING)
    classes = ((static, STATIC, GREY, "static class"), (passing, PASSING, ORANGE, "passing class"))
    for p, (rho, tau), colour, name in classes:
        t, q = _with_predictions(times, p, rho, tau)
        axes[1].plot(t, q, "-", color=colour, label=name, linewidth=1.2)
    # P(static) of what ended here: without the factor rho a of the beam's own hit
    log_odds = np.log(SHARE_STATIC / (1 - SHARE_STATIC)) + log_static - log_passing
    log_odds += np.log(PASSING[0] / STATIC[0])
    posterior = 1 / (1 + np.exp(-np.clip(log_odds, -50, 50)))
    first = int(np.argmax(hits))
    axes[2].step(times[first:], posterior[first:], where="post", color=BLUE, linewidth=1.2)
    for axis in axes:
        axis.tick_params(labelsize=7)
    for axis in axes[1:]:
        axis.set_ylim(-0.05, 1.05)
        axis.grid(alpha=0.3)


def _with_predictions(
    times: np.ndarray, p: np.ndarray, rho: float, tau: float
) -> tuple[np.ndarray, np.ndarray]:
    """The filter's probability with what it predicts between observations."""
    t, q = [times[:1]], [p[:1]]
    for k in range(len(times) - 1):
        between = np.linspace(times[k], times[k + 1], 20, endpoint=False)
        t += [between, times[k + 1 : k + 2]]
        q += [rho + (p[k] - rho) * np.exp(-(between - times[k]) / tau), p[k + 1 : k + 2]]
    return np.concatenate(t), np.concatenate(q)


def main() -> None:
    """Simulate, map, draw."""
    changes = {
        "crowd": {"people": 40},
        "laser": {"max_range": 8.0},
        "robot": {"scans": SCANS},
    }
    recording = simulate(scene_by_name("hall", changes), SEED).recording
    result = stillmap.build(recording)
    draw_maps(result)
    draw_timeline(result)


if __name__ == "__main__":
    main()
