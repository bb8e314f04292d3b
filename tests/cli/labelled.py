"""Results with given labels, as `stillmap map` would write them."""

import json
from pathlib import Path

import numpy as np

from stillmap.core.recording import Recording
from stillmap.io import read


def label(
    source: Path, folder: Path, share: float = 0.3, options: dict[str, object] | None = None
) -> tuple[Recording, np.ndarray]:
    """Write a result of a recording in which a share of the hits is dynamic, by chance.

    Returns:
        The recording, and (M,) whether beams are dynamic.
    """
    from stillmap.preprocessing.options import ReadOptions

    recording = read(source, ReadOptions(**(options or {})))
    rng = np.random.default_rng(5)
    blank = recording.hit & (rng.random(recording.n_beams) < share)
    p_static = np.where(blank, 0.1, 0.9).astype(np.float32)
    usable = ~np.isnan(recording.points).any(axis=1)
    (folder / "beams").mkdir(parents=True)
    for name, array in (
        ("stamp_ns", recording.stamp_ns),
        ("offset", recording.offset),
        ("hit", recording.hit),
        ("p_static", np.where(usable, p_static, np.float32(np.nan))),
    ):
        np.save(folder / "beams" / f"{name}.npy", array)
    if recording.dimension == 3:
        (folder / "static.ply").write_text("")
    record = {"input": {"path": str(source)}, "options": {"read": options or {}}}
    (folder / "run.json").write_text(json.dumps(record))
    return recording, blank
