"""Readers of simulations with cameras, and of models in result folders."""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import model_surface
import numpy as np
from model_objects import Model, MoverHits, Track
from model_surface import SAMPLES, ColoredPoints, TextureRecord, TrueImages
from numpy.typing import NDArray
from true_surfaces import project_to_static

from stillmap.core.array_folder import open_npy, read_npz
from stillmap.core.errors import InputError, import_extra
from stillmap.core.input_files import read_bytes
from stillmap.core.json import read_json
from stillmap.results.eval import readers
from stillmap.sim.truth import ImageTruth, load_image_truth
from stillmap.slam.deskew import deskew_recording
from stillmap.slam.options import SlamOptions

Float = NDArray[np.float64]

RECORD = "mesh_faces.npz"
_VOXEL = 0.05  # m, for thinning the observed surface points
_SPAN_NS = 10**9  # before and after the model of a person, who walks on
_MAX_JSON = 1 << 28  # bytes
_MAX_GLB, _MAX_ARRAY = 4 << 30, 1 << 31  # bytes of a file, of an unpacked array


class CameraSimulation(NamedTuple):
    """A simulated recording with cameras, and its truth.

    Attributes:
        truth: its folder, recording and truth about beams.
        images, image_truth: the images, and the truth about them and about surfaces.
        end_points: (M, 3) measured end points in the world, at true poses.
    """

    truth: readers.Truth
    images: TrueImages
    image_truth: ImageTruth
    end_points: Float

    def observed_places(self, max_range: float) -> Float:
        """(n, 3) observed points of the true static surfaces, one per voxel of 5 cm.

        Args:
            max_range: metres, longer beams are ignored.
        """
        recording = self.truth.recording
        use = recording.hit & self.truth.static()
        use &= np.linalg.norm(recording.points, axis=1) <= max_range
        _, places = project_to_static(self.image_truth.standing, self.end_points[use])
        return places[model_surface.first_per_voxel(places, _VOXEL)]

    def mover_hits(self) -> MoverHits:
        """The hits on movers."""
        recording = self.truth.recording
        mover = open_npy(self.truth.folder / "truth/mover.npy")
        beams = np.flatnonzero(recording.hit & (mover >= 0))
        stamps = recording.stamp_ns[recording.scans_of(beams)]
        if recording.beam_time is not None:
            stamps = stamps + np.rint(1e9 * recording.beam_time[beams].astype(float)).astype(int)
        return MoverHits(mover[beams], stamps, self.end_points[beams])


def read_camera_simulation(path: Path) -> CameraSimulation:
    """Read a simulation with cameras; of a rig the recording with them.

    Raises:
        InputError: it is none.
    """
    if (path / "tilting").is_dir():
        path = path / "tilting"
    truth, picture_truth = readers.read_truth(path), load_image_truth(path)
    recording, images = truth.recording, truth.recording.images
    if images is None or len(images) != len(picture_truth.T_world_camera):
        raise InputError("has other images than its truth", where=str(path))
    pictures = TrueImages(
        images.cameras,
        images.camera,
        picture_truth.T_world_camera,
        picture_truth.mask,
        picture_truth.distance,
    )
    T_world_base = truth.poses()
    at_once = deskew_recording(recording, T_world_base, SlamOptions())
    ends = at_once.end_points(np.arange(recording.n_beams), T_world_base)
    return CameraSimulation(truth, pictures, picture_truth, ends)


class GlbContent(NamedTuple):
    """The content of a GLB file, z up.

    Attributes:
        vertices, faces: (V, 3) metres and (F, 3), of all parts.
        coloured: points of its textures, as dense everywhere.
    """

    vertices: Float
    faces: NDArray[np.int32]
    colored: ColoredPoints


def read_glb(path: Path, n: int = SAMPLES) -> GlbContent:
    """Read a GLB file, with n points of its textures.

    Raises:
        InputError: it is damaged, or trimesh is not installed.
    """
    data = io.BytesIO(read_bytes(path, _MAX_GLB))
    trimesh = import_extra("trimesh", path, "compared with the truth", group="mesh")
    try:
        parts = list(_parts(trimesh.load_scene(data, file_type="glb", process=False)))
        return _concatenate(parts, n)
    except Exception as error:  # whatever trimesh makes of damaged bytes
        raise InputError(f"is damaged: {error}", where=str(path)) from error


class _Part(NamedTuple):
    vertices: Float
    faces: NDArray[np.int32]
    uv: Float | None
    picture: NDArray[np.uint8] | None


def _parts(scene: Any) -> Iterator[_Part]:
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph[node]
        mesh = scene.geometry[name]
        x, y, z = (np.asarray(mesh.vertices, float) @ T[:3, :3].T + T[:3, 3]).T
        vertices = np.stack([x, -z, y], axis=1)  # y is up in the file
        material = getattr(mesh.visual, "material", None)
        image = getattr(material, "baseColorTexture", None)
        uv = getattr(mesh.visual, "uv", None)
        faces = np.asarray(mesh.faces, np.int32)
        if image is None or uv is None:
            yield _Part(vertices, faces, None, None)
        else:
            yield _Part(vertices, faces, np.asarray(uv, float), np.asarray(image.convert("RGB")))


def _concatenate(parts: list[_Part], n: int) -> GlbContent:
    vertices, faces, first = [np.empty((0, 3))], [np.empty((0, 3), np.int32)], 0
    points, colour = [np.empty((0, 3))], [np.empty((0, 3), np.uint8)]
    area = [float(model_surface.triangle_areas(one.vertices, one.faces).sum()) for one in parts]
    total = sum(a for a, one in zip(area, parts, strict=True) if one.uv is not None)
    for a, one in zip(area, parts, strict=True):
        vertices.append(one.vertices)
        faces.append(one.faces + np.int32(first))
        first += len(one.vertices)
        if one.uv is not None and one.picture is not None and a > 0.0:
            count = max(1, round(n * a / total))
            some = model_surface.sample_surface(one.vertices, one.faces, count)
            uv = np.einsum("nk,nkd->nd", some.weight, one.uv[one.faces[some.face]])
            points.append(some.points)
            colour.append(_texels(one.picture, uv))
    coloured = ColoredPoints(np.concatenate(points), np.concatenate(colour))
    return GlbContent(np.concatenate(vertices), np.concatenate(faces), coloured)


def _texels(picture: NDArray[np.uint8], uv: Float) -> NDArray[np.uint8]:
    """(n, 3) bilinear colors at (n, 2); the origin is the lower left corner."""
    height, width, _ = picture.shape
    at = np.stack([uv[:, 0] * width - 0.5, (1.0 - uv[:, 1]) * height - 0.5], axis=1)
    at = np.clip(at, 0.0, (width - 1, height - 1))
    low = np.minimum(at.astype(np.int64), np.maximum((width - 2, height - 2), 0))
    right, down = (at - low).T[:, :, None]
    (column, row), across = low.T, min(width - 1, 1)
    below = row + min(height - 1, 1)
    upper = picture[row, column] * (1 - right) + picture[row, column + across] * right
    lower = picture[below, column] * (1 - right) + picture[below, column + across] * right
    out: NDArray[np.uint8] = np.rint(upper * (1 - down) + lower * down).astype(np.uint8)
    return out


def read_record(path: Path, n_pictures: int, frame: str = "map") -> TextureRecord | None:
    """Read `mesh_faces.npz` or `NNNN_faces.npz`; None if it does not exist.

    Args:
        path: the file.
        n_pictures: number of images of the recording.
        frame: of the model, "map" or "object".

    Raises:
        InputError: it is damaged, or of other images.
    """
    if not path.exists():
        return None
    names = ("vertices", "faces", "image", f"T_camera_{frame}")
    columns = [*read_npz(path, names, _MAX_ARRAY).values()]
    try:
        vertices = np.asarray(columns[0], np.float64).reshape(-1, 3)
        faces = np.asarray(columns[1], np.int32).reshape(-1, 3)
        image = np.asarray(columns[2], np.int32).reshape(len(faces))
        T = np.asarray(columns[3], np.float64).reshape(-1, 4, 4)
    except (ValueError, TypeError) as error:
        raise InputError(f"is damaged: {error}", where=str(path)) from error
    if len(T) != n_pictures or image.max(initial=-1) >= n_pictures or image.min(initial=0) < -1:
        what = f"has {len(T)} images, the recording {n_pictures}"
        raise InputError(what, where=str(path), hint="is it the result of another recording?")
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise InputError("is damaged: no such vertex", where=str(path))
    if not np.isfinite(T[np.unique(image[image >= 0])]).all():
        raise InputError("is damaged: a texture image without a pose", where=str(path))
    return TextureRecord(vertices, faces, image, T)


def find_objects_folder(result: Path) -> Path:
    """The folder of the objects with models; of a rig, those of the tilting laser."""
    tilting = result / "tilting/objects"
    has_models = any((result / "objects").glob("[0-9]*.glb"))
    return tilting if tilting.is_dir() and not has_models else result / "objects"


def read_tracks(folder: Path, T_world_map: Float) -> list[Track]:
    """Read `objects.json`, transformed to the world.

    Raises:
        InputError: it is missing or damaged.
    """
    path = folder / "objects.json"
    out, content = [], read_json(path, _MAX_JSON)
    if not isinstance(content, list):
        raise InputError("is damaged: no list of objects", where=str(path))
    for one in content:
        try:
            track = one["track"]
            xy = np.column_stack([track["x"], track["y"]]).astype(float)
            points = np.column_stack([xy, np.zeros(len(xy))]) @ T_world_map[:3, :3].T
            stamps = np.array(track["stamp_ns"], np.int64)
            out.append(Track(int(one["id"]), stamps, points[:, :2] + T_world_map[:2, 3]))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"is damaged: {error!r}", where=str(path)) from error
    return out


def read_model(folder: Path, id: int, rigid: bool, n_pictures: int) -> Model | None:
    """Read the model of an object; None if it does not exist.

    Args:
        folder: `objects/`.
        id: of the object.
        rigid: whether its model may hold observations of all times, where `NNNN.json` does not
            say.
        n_pictures: number of images of the recording.

    Raises:
        InputError: a file is damaged.
    """
    path = folder / f"{id:04d}.glb"
    if not path.exists():
        return None
    glb, about = read_glb(path, n=1), path.with_suffix(".json")
    try:
        content = read_json(about, _MAX_JSON)
        T, stamp = np.array(content["T_map_object"], float).reshape(4, 4), int(content["stamp_ns"])
        first, last = content.get("first_stamp_ns"), content.get("last_stamp_ns")
        if first is None or last is None:
            rigid = bool(content.get("rigid", rigid))
            first, last = (-(2**62), 2**62) if rigid else (stamp - _SPAN_NS, stamp + _SPAN_NS)
        span = int(first), int(last)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"is damaged: {error!r}", where=str(about)) from error
    record = read_record(folder / f"{id:04d}_faces.npz", n_pictures, "object")
    return Model(glb.vertices, glb.faces, T, stamp, span, record)
