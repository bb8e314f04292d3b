"""How good a map is, without truth: how well it foresees scans that it was not made from.

`docs/quality.md` says what the figure means, and what it was found to be worth.
"""

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.chunks import iter_chunks
from stillmap.core.recording import Recording

Float = NDArray[np.float64]

# The same for every recording: rates and widths learned from it would excuse what is to be found
# out, a blurred map above all.
BEAM_MODEL = {
    "stopping_rate": 15.0,  # per metre, by what is surely static
    "range_std": 0.1,  # m, of range and pose: less would see little but the poses' errors
    "late_share": 0.6,  # share of beams that graze, or pass an edge, and end somewhere behind it
    "mean_delay": 0.3,  # m, how far behind it on average
    "outlier_share": 0.01,
}


def select_held_out_scans(n_scans: int, every: int) -> NDArray[np.bool_]:
    """(T,) the scans that are left out: one in the middle of every `every` in a row; 0: none."""
    if every == 0:
        return np.zeros(n_scans, dtype=np.bool_)
    return np.asarray(np.arange(n_scans) % every == every // 2, dtype=np.bool_)


def score_held_out_scans(
    recording: Recording,
    poses: Float,
    e: NDArray[np.float32],
    resolution: float,
    every: int,
    threads: int = 1,
) -> float | None:
    """Log likelihood of held-out ranges at the map that the other scans make, in nats per beam.

    Args:
        recording: 2D or 3D.
        poses: (T, D+1, D+1) T_map_base.
        e: (M,) P(c = 1) of every beam.
        resolution: m, edge of a cell.
        every: one of so many scans is held out; 0: none.
        threads: same result with any number.

    Returns:
        The mean over beams of ln p(z) - ln q(z); None where fewer than `every` scans or no usable
        beams are there.

    With s_j the mean e of the other scans' hits in cell j, a beam meets what is static at h_j =
    stopping_rate s_j per metre and what moves at lambda = sum (1 - e) / sum of lengths. The range
    density of what it meets after the way r is H(r) = (h_j + lambda) exp(-integral of it up to r);
    what is static is measured at z = r + noise, or at r + Exp(mean_delay). q is the density of a
    world without a map, in which beams end at the same rate everywhere; a share `outlier_share` of
    p is q. Both integrate to one over z, together with the probability that nothing stops the beam.
    """
    if every == 0 or recording.n_scans < every:
        return None
    held = select_held_out_scans(recording.n_scans, every)
    T_map_sensor = recording.T_map_sensor(poses)
    kind = _core.StaticFractionGrid2D if recording.dimension == 2 else _core.StaticFractionGrid3D
    shares = kind(resolution)
    for scans, beams, offset in iter_chunks(recording, release=[e]):
        points, hit = recording.points[beams], recording.hit[beams]
        shares.add(points, hit, e[beams], offset, T_map_sensor[scans], held[scans])
    gain, count = 0.0, 0.0
    for scans, beams, offset in iter_chunks(recording):
        points, hit = recording.points[beams], recording.hit[beams]
        per_scan = _core.score_held_out(
            shares, points, hit, offset, T_map_sensor[scans], held[scans], threads=threads,
            **BEAM_MODEL,
        )  # fmt: skip
        gain += float(per_scan[:, 0].sum())
        count += float(per_scan[:, 1].sum())
    return gain / count if count else None
