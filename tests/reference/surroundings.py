"""Surroundings of surfels: whether beams still ended beside a surfel while others passed it."""

from reference.observation import HIT


def coarse_cell(surfel, edge):
    """The cell, `edge` cells wide, that a surfel lies in."""
    x, y, z = (int(v) // edge for v in surfel.cell)
    return x, y, z


def surrounded(surfels, hits, edge):
    """The surfels in or beside whose coarse cell, level with it, one without a plane is hit."""
    rough = [surfels[k] for k in hits if surfels[k].plane is None]
    occupied = {
        (x + dx, y + dy, z)
        for x, y, z in (coarse_cell(surfel, edge) for surfel in rough)
        for dx in (-1, 0, 1)
        for dy in (-1, 0, 1)
    }
    return {k for k, surfel in enumerate(surfels) if coarse_cell(surfel, edge) in occupied}


def mark_misses(seen, surfels, edge):
    """Observations of one time bin: HIT or reliability, and whether the surroundings were hit."""
    around = surrounded(surfels, [k for k, value in seen.items() if value == HIT], edge)
    return {k: (value, k in around) for k, value in seen.items()}


def count_misses(history):
    """Misses of a surfel, all and surrounded, by reliability; none one time bin from a hit.

    Args:
        history: by time bin, see `mark_misses`.
    """
    hits = {n for n, (value, _) in history.items() if value == HIT}
    misses = [
        (reliability, is_surrounded)
        for n, (reliability, is_surrounded) in history.items()
        if hits.isdisjoint({n - 1, n, n + 1})
    ]
    return sum(r for r, _ in misses), sum(r for r, is_surrounded in misses if is_surrounded)
