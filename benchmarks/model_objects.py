"""Scores of object models against the true shapes of a simulation's movers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import model_surface
import numpy as np
from model_surface import (
    GREY,
    Index,
    TextureRecord,
    TrueImages,
    look_up_texture_source,
    transform_points,
)
from numpy.typing import NDArray
from true_surfaces import place_parts, project_to_solid, to_world

from stillmap.results.eval.labels import NAN, Float, Scores, mean
from stillmap.sim.geometry import MovingSurfaces, Solids, to_local

_SAMPLES = 20_000
_VOXEL = 0.02  # m, for thinning the observed points
_SPACING = 0.03  # m, of the lattice of a model
_MAX_OFFSET = 0.75  # m from a track to its mover's center, plus half the mover's length
GOOD = 0.05  # m, chamfer distance
_MIN_BEAMS = 100  # within a second, of a well observed mover


class Track(NamedTuple):
    """Track of an object: (L,) stamps, (L, 2) metres in the world."""

    id: int
    stamp_ns: NDArray[np.int64]
    xy: Float

    def within(self, span_ns: tuple[int, int]) -> "Track":
        """The part between two times, or the detection nearest to their mean."""
        first, last = span_ns
        use = np.flatnonzero((self.stamp_ns >= first) & (self.stamp_ns <= last))
        if not len(use):
            use = np.array([np.abs(self.stamp_ns - (first + last) // 2).argmin()])
        return self._replace(stamp_ns=self.stamp_ns[use], xy=self.xy[use])


class Model(NamedTuple):
    """The model of an object.

    Attributes:
        vertices, faces: (V, 3) metres in the object's frame, z up, and (F, 3).
        T_map_object: (4, 4) pose of the object at `stamp_ns`.
        stamp_ns: time of the model.
        span_ns: first and last time of the observations in the model.
        record: sources of its texture; None: unknown, or no texture.
    """

    vertices: Float
    faces: Index
    T_map_object: Float
    stamp_ns: int
    span_ns: tuple[int, int]
    record: TextureRecord | None


@dataclass(frozen=True)
class ModelScores(Scores):
    """Scores of one model; metres. NaN where there is nothing to compare.

    Attributes:
        id, mover, kind: of the object, and its mover.
        accuracy: mean distance of the model from the true shape.
        completeness: mean distance of the observed points of the true shape from the model.
        chamfer: mean of both.
        textured: share of the area with a texture.
        background: share of the textured area that does not show the mover.
    """

    id: int
    mover: int
    kind: str
    accuracy: float
    completeness: float
    chamfer: float
    textured: float
    background: float


@dataclass(frozen=True)
class MoverScores(Scores):
    """Scores of all models. NaN where there is nothing to compare.

    Attributes:
        tracked: number of tracked movers.
        modelled: share of them with a model.
        seen_well: tracked movers with 100 beams within some second.
        modelled_well: share of these with a model.
        chamfer: mean over models, metres.
        good: share of models with a chamfer distance of at most 5 cm.
        background: mean over models with a texture.
        nothing: models of no mover.
        models: all others.
    """

    tracked: int
    modelled: float
    seen_well: int
    modelled_well: float
    chamfer: float
    good: float
    background: float
    nothing: int
    models: tuple[ModelScores, ...]


class MoverHits(NamedTuple):
    """B hits on movers.

    Attributes:
        mover: (B,) mover.
        stamp_ns: (B,) time.
        points: (B, 3) end point in the world.
    """

    mover: Index
    stamp_ns: NDArray[np.int64]
    points: Float


def match_mover(track: Track, stamp_ns: NDArray[np.int64], movers: Float, sizes: Float) -> int:
    """The mover nearest to an object's track; -1: none.

    Args:
        track: of the object.
        stamp_ns, movers: (T,) stamps and (T, P, 3) poses of the movers; x, y in metres.
        sizes: (P,) metres, lengths; NaN where undefined, as of people.
    """
    scan = np.clip(np.searchsorted(stamp_ns, track.stamp_ns), 0, len(stamp_ns) - 1)
    off = np.linalg.norm(movers[scan, :, :2] - track.xy[:, None], axis=2)
    off = np.median(np.where(np.isnan(off), np.inf, off), axis=0)
    near = off - _MAX_OFFSET - np.nan_to_num(sizes) / 2
    return int(near.argmin()) if near.size and near.min() <= 0.0 else -1


def score_object_models(
    tracked: Mapping[int, int],
    models: Mapping[int, tuple[int, Model]],
    kinds: Sequence[str],
    moving: MovingSurfaces,
    sighted: MoverHits,
    pictures: TrueImages,
    T_world_map: Float,
) -> MoverScores:
    """Score the models of objects.

    Args:
        tracked: mover of each object, by object id; -1: none.
        models: mover at the time of the model, and model, by object id. Models of no mover are only
            counted.
        kinds: of movers.
        moving: the true shapes.
        sighted: hits on movers.
        pictures: the images.
        T_world_map: (4, 4).
    """
    movers = {mover for mover in tracked.values() if mover >= 0}
    have = {tracked.get(id, -1) for id in models}
    well = {mover for mover in movers if count_max_beams(sighted, mover) >= _MIN_BEAMS}
    scores = tuple(
        score_model(id, mover, kinds[mover], model, moving, sighted, pictures, T_world_map)
        for id, (mover, model) in sorted(models.items())
        if mover >= 0
    )
    chamfer = _drop_nan([one.chamfer for one in scores])
    return MoverScores(
        tracked=len(movers),
        modelled=len(have & movers) / len(movers) if movers else NAN,
        seen_well=len(well),
        modelled_well=len(have & well) / len(well) if well else NAN,
        chamfer=mean(chamfer),
        good=mean(chamfer <= GOOD),
        background=mean(_drop_nan([one.background for one in scores])),
        nothing=len(models) - len(scores),
        models=scores,
    )


def count_max_beams(sighted: MoverHits, mover: int) -> int:
    """Maximum number of beams on a mover within a second."""
    stamps = np.sort(sighted.stamp_ns[sighted.mover == mover])
    last = np.searchsorted(stamps, stamps + 10**9, side="right")
    return int((last - np.arange(len(stamps))).max(initial=0))


def score_model(
    id: int,
    mover: int,
    kind: str,
    model: Model,
    moving: MovingSurfaces,
    sighted: MoverHits,
    pictures: TrueImages,
    T_world_map: Float,
) -> ModelScores:
    """Score one model; for arguments see `score_object_models`."""
    solids = place_parts(moving, moving.parts(mover), model.stamp_ns)
    T = T_world_map @ model.T_map_object
    on_model = model_surface.sample_surface(model.vertices, model.faces, _SAMPLES).points
    accuracy = mean(distance_to_solids(transform_points(T, on_model), solids))
    places = collect_observed_points(moving, mover, model.stamp_ns, model.span_ns, sighted)
    vertices = transform_points(T, model.vertices)
    completeness = mean(model_surface.distance_to_mesh(places, vertices, model.faces, _SPACING))
    textured = background = NAN
    if (record := model.record) is not None:
        of_record = model_surface.sample_surface(record.vertices, record.faces, _SAMPLES)
        source = look_up_texture_source(record, of_record, pictures)
        textured = mean(source != GREY)
        background = mean(source[source != GREY] != mover)
    chamfer = (accuracy + completeness) / 2
    return ModelScores(id, mover, kind, accuracy, completeness, chamfer, textured, background)


def distance_to_solids(points: Float, solids: Solids) -> Float:
    """(n,) metres to the nearest of solids at one time."""
    out = np.full(len(points), np.inf)
    for k in range(len(solids.form)):
        off = np.linalg.norm(project_to_solid(points, solids, k) - points, axis=1)
        np.fmin(out, off, out=out)
    return out


def collect_observed_points(
    moving: MovingSurfaces, mover: int, stamp_ns: int, span_ns: tuple[int, int], sighted: MoverHits
) -> Float:
    """Observed points (n, 3) of a mover, moved to where they are at a stamp; in the world.

    Each end point is projected to the part nearest to it at its own time, and moves with it.

    Args:
        moving, mover, sighted: see `score_object_models`.
        stamp_ns: time of the points.
        span_ns: first and last time of the beams used.
    """
    first, last = span_ns
    use = (sighted.mover == mover) & (sighted.stamp_ns >= first) & (sighted.stamp_ns <= last)
    points, stamps = sighted.points[use], sighted.stamp_ns[use]
    parts = moving.parts(mover)
    then, now = place_parts(moving, parts, stamps), place_parts(moving, parts, stamp_ns)
    nearest, found = np.full(len(points), np.inf), np.full((len(points), 3), np.nan)
    for k in range(len(parts)):
        on = project_to_solid(points, then, k)
        off = np.linalg.norm(on - points, axis=1)
        better = off < nearest
        moved = to_world(to_local(on, then.pose[:, k]), now.pose[:, k])
        nearest[better], found[better] = off[better], moved[better]
    found = found[np.isfinite(found).all(axis=1)]
    return np.asarray(found[model_surface.first_per_voxel(found, _VOXEL)])


def _drop_nan(values: Sequence[float]) -> Float:
    array = np.array(values, np.float64)
    return np.asarray(array[~np.isnan(array)])
