"""Scores of the surface, texture and object models of a result, against a simulation's truth.

python benchmarks/model_scores.py RESULT TRUTH [--within M]

Distance of the mesh from the true surface, and its completeness; colour errors of the texture, and
its share that shows movers; shapes and textures of object models. The simulation needs cameras;
--within expects only what beams and images saw from at most M metres. Prints JSON.
"""

import json
from pathlib import Path
from typing import Any

import model_readers
import numpy as np
from common import make_parser
from model_objects import MoverScores, match_mover, score_object_models
from model_readers import CameraSimulation
from model_surface import score_surface, score_texture
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.core.json import to_jsonable
from stillmap.io.trajectory import embed_in_3d
from stillmap.results.eval import trajectory
from stillmap.results.eval.trajectory import read_paired_poses
from stillmap.results.reader import require_there
from stillmap.sim.truth import load_truth

Float = NDArray[np.float64]


def main() -> None:
    p = make_parser(__doc__)
    p.add_argument("result", type=Path, metavar="RESULT")
    p.add_argument("truth", type=Path, metavar="TRUTH")
    p.add_argument("--within", type=float, default=float("inf"), metavar="M")
    args = p.parse_args()
    print(json.dumps(to_jsonable(score_model(args.result, args.truth, args.within))))


def score_model(result: Path, truth_folder: Path, max_distance: float) -> dict[str, Any]:
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
    path = result / "mesh.glb"
    if not path.is_file():
        raise InputError("holds no model", where=str(result), hint="mesh.enabled=true makes it")
    glb = model_readers.read_glb(path)
    standing, places = seen.image_truth.standing, seen.observed_places(max_distance)
    surface = score_surface(glb.vertices, glb.faces, standing, places, T_world_map)
    scores["surface"] = surface.to_dict()
    n = len(seen.images.camera)
    record = model_readers.read_record(result / model_readers.RECORD, n)
    if record is not None:
        seed = seen.image_truth.colour_seed
        texture = score_texture(
            record, glb.colored, seen.images, standing, seed, T_world_map, max_distance
        )
        scores["texture"] = texture.to_dict()
    if (model_readers.find_objects_folder(result) / "objects.json").exists():
        movers = _score_movers(result, seen, T_world_map)
        scores["movers"] = movers.to_dict()
    return scores


def _align(result: Path, seen: CameraSimulation) -> Float:
    """(4, 4) T_world_map."""
    T = trajectory.align(
        *trajectory.project_flat_trajectories(*read_paired_poses(result, seen.truth))
    )
    return embed_in_3d(T)


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


if __name__ == "__main__":
    main()
