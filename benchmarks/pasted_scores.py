"""How much of a room's texture shows the people who were pasted into its pictures.

python benchmarks/pasted.py ../shared/data/rgbd/kitchenette OUT
python benchmarks/pasted_scores.py OUT [--set section.key=value ...] [--keep DIR]

`stillmap map` makes the model with the recorded poses. Points uniform over its area are looked up
in the masks of people of their source images. Free is what some image shows without people.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import model_surface
import numpy as np
from common import make_parser
from model_readers import RECORD, read_record
from model_surface import GREY, SAMPLES, TextureRecord, TrueImages, look_up_texture_source
from numpy.typing import NDArray
from tables import Column, markdown

import stillmap
from stillmap.core import camera as camera_module
from stillmap.core.camera import Images
from stillmap.core.errors import InputError
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.mesh.views import View
from stillmap.mesh.visibility import find_visible_faces
from stillmap.prepare.options import ReadOptions

Mask = NDArray[np.bool_]

COLUMNS = (
    Column("area", "area, m2", ".1f"),
    Column("painted", "painted, %", ".1f", True),
    Column("free", "free, %", ".1f", True),
    Column("covered", "of that painted, %", ".1f", True),
    Column("person", "shows people, %", ".3f"),
    Column("seconds", "s", ".0f"),
    Column("memory", "GB", ".2f"),
)


class Scores(NamedTuple):
    """Of a mesh. NaN where there is nothing to compare.

    Attributes:
        area: square metres.
        painted: share of its area that a picture paints.
        free: share that some picture shows without a person before it.
        covered: share of that which a picture paints.
        person: share of what is painted that shows a person.
    """

    area: float
    painted: float
    free: float
    covered: float
    person: float


def scores(record: TextureRecord, images: Images, people: Mask) -> Scores:
    """Score what paints a mesh.

    Args:
        record: which picture paints each face.
        images: that may paint it.
        people: (N, height, width) where each shows a person.
    """

    def mask(image: int) -> NDArray[np.uint16]:
        return people[image].astype(np.uint16)

    def distance(image: int) -> NDArray[np.float32]:
        raise NotImplementedError("how far pixels see is not looked up")

    at = model_surface.sample_surface(record.vertices, record.faces, SAMPLES)
    places = np.full((len(images), 4, 4), np.nan)
    shows = look_up_texture_source(
        record, at, TrueImages(images.cameras, images.camera, places, mask, distance)
    )
    painted, free = shows != GREY, _free(record, at, images, people)
    return Scores(
        area=float(model_surface.triangle_areas(record.vertices, record.faces).sum()),
        painted=_mean(painted),
        free=_mean(free),
        covered=_mean(painted[free]),
        person=_mean(shows[painted] >= 0),
    )


def _free(
    record: TextureRecord, at: model_surface.SurfaceSamples, images: Images, people: Mask
) -> Mask:
    """(n,) whether a picture that sees a sample's whole face shows no person there."""
    out, mesh = np.zeros(len(at.face), bool), Mesh(record.vertices, record.faces)
    for image, T in enumerate(record.T_camera_model):
        if not np.isfinite(T).all():
            continue
        camera = images.cameras[images.camera[image]]
        view = View(image, int(images.stamp_ns[image]), camera, T)
        some = np.flatnonzero(~out & (find_visible_faces(mesh, view)[at.face] > 0.0))
        column, row = np.rint(camera_module.project(camera, view.to_camera(at.points[some]))[0].T)
        out[some] = ~people[image][row.astype(np.intp), column.astype(np.intp)]
    return out


def _mean(values: Mask) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def row(source: Path, result: Path, settings: Sequence[str]) -> dict[str, Any]:
    """Map a folder that `pasted.py` wrote, and score it; shares in percent.

    Args:
        source: that folder.
        result: where the model goes; what is there is replaced.
        settings: `section.key=value`.
    """
    flags = [part for one in settings for part in ("--set", one)]
    words = ["map", source, "--poses", "recording", "-o", result, "--overwrite", "--quiet", *flags]
    subprocess.run([sys.executable, "-m", "stillmap", *map(str, words)], check=True)
    images = stillmap.read(source, options=ReadOptions(depth_step=64)).images
    if images is None:
        raise InputError("has no pictures", where=str(source))
    record = read_record(result / RECORD, len(images))
    if record is None:
        raise InputError("has no model", where=str(result))
    with np.load(source / "truth.npz") as truth:
        found = scores(record, images, truth["colour"])._asdict()
    done = json.loads((result / "run.json").read_text())
    percent = {key: 100.0 * value for key, value in found.items() if key != "area"}
    seconds, memory = sum(done["seconds"].values()), max(done["peak_memory_bytes"].values())
    return {"area": found["area"], **percent, "seconds": seconds, "memory": 1e-9 * memory}


def main() -> None:
    p = make_parser(__doc__)
    p.add_argument("source", type=Path, help="what pasted.py wrote")
    p.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    p.add_argument("--keep", type=Path, metavar="DIR", help="leave the results there")
    args = p.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        kept = args.keep or Path(folder)
        kept.mkdir(parents=True, exist_ok=True)
        found = row(args.source, kept / "result-0", args.set)
    header = [column.title for column in COLUMNS]
    print(markdown(header, [[c.mean_and_worst([found]) for c in COLUMNS]]))


if __name__ == "__main__":
    main()
