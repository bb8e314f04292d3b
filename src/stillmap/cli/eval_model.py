"""Compute and format the scores of `stillmap eval model`."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.eval import model_readers, trajectory
from stillmap.eval.mesh import SurfaceScores, TextureScores, score_surface, score_texture
from stillmap.eval.model_readers import CameraSimulation
from stillmap.eval.object_models import MoverScores, match_mover, score_object_models
from stillmap.eval.trajectory import read_paired_poses
from stillmap.results.reader import require_model, require_there
from stillmap.rig.trajectory import lift_poses
from stillmap.sim.truth import load_truth

Float = NDArray[np.float64]


def score_model(
    result: Path, truth_folder: Path, max_distance: float
) -> tuple[dict[str, Any], Iterable[str]]:
    """Scores of surface, texture and object models, of those that the result has.

    Args:
        result: result folder.
        truth_folder: simulation with cameras.
        max_distance: expect only what was seen from at most this far, m.
    """
    require_there(result, truth_folder)
    seen = model_readers.read_camera_simulation(truth_folder)
    T_world_map = _align(result, seen)
    scores: dict[str, Any] = {"alignment": T_world_map.tolist()}
    lines: list[str] = []
    glb = model_readers.read_glb(require_model(result))
    standing, places = seen.image_truth.standing, seen.observed_places(max_distance)
    surface = score_surface(glb.vertices, glb.faces, standing, places, T_world_map)
    scores["surface"] = surface.to_dict()
    lines += _format_surface(surface)
    n = len(seen.images.camera)
    record = model_readers.read_record(result / model_readers.RECORD, n)
    if record is not None:
        seed = seen.image_truth.colour_seed
        texture = score_texture(
            record, glb.colored, seen.images, standing, seed, T_world_map, max_distance
        )
        scores["texture"] = texture.to_dict()
        lines += _format_texture(texture)
    if (model_readers.find_objects_folder(result) / "objects.json").exists():
        movers = _score_movers(result, seen, T_world_map)
        scores["movers"] = movers.to_dict()
        lines += _format_movers(movers)
    return scores, lines


def _align(result: Path, seen: CameraSimulation) -> Float:
    """(4, 4) T_world_map."""
    T = trajectory.align(
        *trajectory.project_flat_trajectories(*read_paired_poses(result, seen.truth))
    )
    return T if len(T) == 4 else lift_poses(T[None])[0]


def _score_movers(result: Path, seen: CameraSimulation, T_world_map: Float) -> MoverScores:
    truth, folder = load_truth(seen.truth.folder), model_readers.find_objects_folder(result)
    kinds, sizes = truth.scene["mover_kinds"], truth.scene["mover_sizes"]
    length = np.array([np.nan if size[0] is None else size[0] for size in sizes], float)
    stamps = seen.image_truth.moving.stamp_ns
    tracks = [one for one in model_readers.read_tracks(folder, T_world_map) if len(one.xy)]
    tracked = {one.id: match_mover(one, stamps, truth.movers, length) for one in tracks}
    models = {}
    for one in tracks:
        mover = tracked[one.id]
        rigid = mover >= 0 and kinds[mover] != "person"
        model = model_readers.read_model(folder, one.id, rigid, len(seen.images.camera))
        if model is not None:
            # a track may pass from one mover to another
            shows = match_mover(one.within(model.span_ns), stamps, truth.movers, length)
            models[one.id] = shows, model
    moving, sighted = seen.image_truth.moving, seen.mover_hits()
    return score_object_models(tracked, models, kinds, moving, sighted, seen.images, T_world_map)


def _format_surface(s: SurfaceScores) -> Iterable[str]:
    yield f"surface      {s.faces} faces, {s.area:.1f} m2"
    yield f"off truth    mean {_cm(s.mean)}, 95 % below {_cm(s.p95)}"
    yield f"complete     {_percent(s.complete)} of {s.places} places within 5 cm"


def _format_texture(t: TextureScores) -> Iterable[str]:
    yield (
        f"textured     {_percent(t.textured)} of the area, {_percent(t.covered)} of the "
        f"{_percent(t.in_view)} that an image sees without a mover"
    )
    yield f"shows        movers {_percent(t.mover)}, nothing {_percent(t.nothing)}"
    yield f"CIEDE2000    median {t.colour_median:.2f}, 95 % below {t.colour_p95:.2f}"


def _format_movers(m: MoverScores) -> Iterable[str]:
    yield (
        f"movers       {m.tracked} tracked, {_percent(m.modelled)} with a model; "
        f"of {m.seen_well} seen by 100 beams in a second {_percent(m.modelled_well)}"
    )
    yield (
        f"models       {len(m.models)}: chamfer {_cm(m.chamfer)} on average, "
        f"{_percent(m.good)} within 5 cm; background {_percent(m.background)}; "
        f"of what is no mover {m.nothing} more"
    )
    for one in m.models:
        yield (
            f"  {one.id:04d}       {one.kind} {one.mover}: to truth {_cm(one.accuracy)}, "
            f"from truth {_cm(one.completeness)}, textured {_percent(one.textured)}, "
            f"background {_percent(one.background)}"
        )


def _cm(metres: float) -> str:
    return "-" if math.isnan(metres) else f"{100 * metres:.2f} cm"


def _percent(share: float) -> str:
    return "-" if math.isnan(share) else f"{100 * share:.2f} %"
