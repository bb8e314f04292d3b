"""The default E-step: what stands still is what never leaves. `docs/estimator.md` derives it."""

import numpy as np
from numpy.typing import NDArray

from stillmap.em.bodies import Feet
from stillmap.em.chunks import chunks
from stillmap.em.expectations import (
    CellProbabilities,
    Expectations,
    Likelihood,
    NoReturn,
    per_beam,
)
from stillmap.em.looks import (
    CLASSES,
    Classes,
    Float,
    Looks,
    Surface,
    Table,
    blocks_of,
    cells_of,
    looked_at,
)
from stillmap.em.mixture import Shares, fit_shares, posterior_static
from stillmap.em.options import EmOptions
from stillmap.recording.model import Recording

_UNSEEN = 0.2  # probability that a cell is occupied in which no beam ended and none passed
_PROMINENT = 0.1  # share of the richest cell's beams that noise alone hardly brings into another
_BELIEVED = 0.5  # trust in beams without a return from which on they show free space
_EDGE = 0.15  # cells: how sharply a surface ends


def e_step(
    recording: Recording,
    poses: Float,
    resolution: float,
    options: EmOptions,
    threads: int = 1,
    classes: Classes = CLASSES,
) -> Expectations:
    """P(c = 1) of every beam: of its end cell being occupied by something that stays.

    Args:
        recording: 2D or 3D.
        poses: (T, D+1, D+1) T_map_base.
        resolution: m, edge of a cell.
        options: see EmOptions.
        threads: same result with any number.
        classes: see Classes.
    """
    looks = looked_at(recording, poses, resolution, options, threads, classes)
    return expectations_of(looks, None, recording, poses, options, threads)


def expectations_of(
    looks: Looks,
    kept: NDArray[np.bool_] | None,
    recording: Recording,
    poses: Float,
    options: EmOptions,
    threads: int,
    static: NDArray[np.float32] | None = None,
    feet: Feet | None = None,
) -> Expectations:
    """What the looks say of every cell, and with that of every beam that ended in it.

    kept (C,): under which of the classes; None: all. static (E,) is what is known better of each
    cell than these say, and with that of all cells. feet: what is known of beams that end on the
    ground below something that moves.
    """
    some = looks.under(kept, looks.sample())
    shares = fit_shares(some.likelihood, some.n_static, options.prior)
    found, likelihood = _of_elements(looks, kept, shares)
    share = shares.static if static is None else _mean(static, shares.static)
    static = found if static is None else static
    surface, T_map_sensor = looks.surface, recording.T_map_sensor(poses)
    beyond = options.dwell.beyond if looks.trust >= _BELIEVED else float("inf")
    return Expectations(
        p_static=_of_beams(recording, T_map_sensor, surface, static, share, threads, feet),
        likelihood=likelihood,
        occupied=CellProbabilities(cells_of(surface), static * coverage(surface), _UNSEEN),
        learned=_learned(looks, some, shares) | {"p_static": share},
        no_return=NoReturn(looks.dwell.solid(), beyond),
    )


def _mean(static: NDArray[np.float32], of_none: float) -> float:
    return float(np.mean(static, dtype=np.float64)) if len(static) else of_none


def coverage(surface: Surface) -> NDArray[np.float32]:
    """(E,) P(what is there runs through the cell itself): noise also fills cells beside it."""
    from scipy.special import ndtr  # takes long to load

    covered = np.empty(surface.size, np.float32)
    for rows in blocks_of(surface):
        _, _, normals, off_plane, prominence, _ = surface.elements(rows)
        # of the cell, across the surface; a wall on the border of two cells belongs to both
        half = 0.5 * np.abs(normals).sum(axis=1) + _EDGE
        runs = ndtr((half - np.abs(off_plane / surface.resolution)) / _EDGE)
        lone = np.minimum(prominence / _PROMINENT, 1.0)
        covered[slice(*rows)] = np.where(normals.any(axis=1), runs, lone)
    return covered


def _of_beams(
    recording: Recording,
    T_map_sensor: Float,
    surface: Surface,
    static: NDArray[np.float32],
    prior: float,
    threads: int,
    feet: Feet | None,
) -> NDArray[np.float32]:
    """(M,) what is known (E,) of the element that each beam ended in."""
    found = np.append(static, np.float32(prior))  # -1: no element
    e = recording.per_beam(np.float32)
    for scans, beams, offset in chunks(recording, beside=[e]):
        points, hit = recording.points[beams], recording.hit[beams]
        element = surface.elements_of(points, hit, offset, T_map_sensor[scans], threads)
        known = per_beam(points, hit, found.take(element), prior)
        if feet is not None:
            over = feet.of(points, hit, offset, T_map_sensor[scans], element, threads)
            known = np.where(np.isnan(over), known, over)
        e[beams] = known
    return e


def _of_elements(
    looks: Looks, kept: NDArray[np.bool_] | None, shares: Shares
) -> tuple[NDArray[np.float32], Likelihood]:
    """(E,) P(static) by the classes alone, and the bound."""
    static, bound, entropy = np.empty(looks.surface.size, np.float32), 0.0, 0.0
    for rows in looks.blocks():
        table = looks.under(kept, rows)
        static[slice(*rows)] = posterior_static(table.likelihood, shares.classes, table.n_static)
        joint = table.likelihood * shares.classes
        evidence = joint.sum(axis=1)
        r = joint / evidence[:, None]
        entropy -= float(np.sum(r * np.log(np.maximum(r, 1e-30))))
        bound += float(np.sum(np.log(evidence) + table.log_best))
    return static, Likelihood(expected=bound - entropy, bound=bound)


def _learned(looks: Looks, table: Table, shares: Shares) -> dict[str, object]:
    static, movers = slice(None, table.n_static), slice(table.n_static, None)
    return {
        "scatter": looks.surface.scatter,
        "p_static": shares.static,
        "no_return_trusted": round(looks.trust, 6),
        "static_occupied": _shares_of(table.rho[static], shares.classes[static]),
        "mover_occupied": _shares_of(table.rho[movers], shares.classes[movers]),
        "mover_seconds": _shares_of(table.tau[movers], shares.classes[movers]),
    }


def _shares_of(values: Float, shares: Float) -> list[dict[str, float]]:
    """The share of each value among these classes."""
    of = shares / shares.sum()
    return [
        {"value": float(v), "share": round(float(of[values == v].sum()), 6)}
        for v in dict.fromkeys(values.tolist())
    ]
