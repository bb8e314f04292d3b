"""Writes meshes as binary glTF (y up), and reads them.

trimesh writes the files with 1 x 1 placeholder images, which are replaced by compressed pages.
"""

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stillmap.core.array_types import Float, Index
from stillmap.core.errors import InputError, import_extra
from stillmap.core.files import atomic_file
from stillmap.core.input_files import read_bytes
from stillmap.mesh.texture import GRAY, TexturedMesh
from stillmap.mesh.triangle_mesh import Mesh

_LINEAR, _LINEAR_MIPMAP_LINEAR, _CLAMP_TO_EDGE = 9729, 9987, 33071  # of glTF samplers
_VERTICES, _INDICES = 34962, 34963  # targets of glTF buffer views
_FAR = 1000.0  # m, coordinates from which on 32-bit floats are coarse


def write_glb(path: Path, mesh: TexturedMesh | Mesh, quality: int = 90) -> None:
    """Writes binary glTF: one unlit mesh per page, and one lit mesh of the gray faces.

    Where coordinates are large, nodes have a translation of whole metres.

    Args:
        path: the file, which appears complete or not at all.
        mesh: with one face at least.
        quality: JPEG quality of the pages; 0: PNG.

    Raises:
        InputError: it cannot be written.
        MissingExtra: trimesh is not installed.
    """
    trimesh = import_extra("trimesh", path, "written", group="mesh")
    gltf = import_extra("trimesh.exchange.gltf", path, "written", group="mesh")
    parts, shift, move = _split_pages(mesh), np.zeros(3), np.eye(4)
    if np.abs(mesh.vertices[mesh.faces]).max(initial=0.0) > _FAR:
        shift = np.rint(np.mean([mesh.vertices[used].mean(axis=0) for _, used, _ in parts], axis=0))
    move[:3, 3] = _y_up(shift)
    scene = trimesh.Scene()
    for page, used, faces in parts:
        name = f"page{page}" if page >= 0 else "grey"
        uv = mesh.uv[used] if isinstance(mesh, TexturedMesh) and page >= 0 else None
        visual = _visual(trimesh, name, page, uv)
        vertices = _y_up(mesh.vertices[used] - shift)
        geometry = trimesh.Trimesh(vertices, faces, visual=visual, process=False)
        scene.add_geometry(geometry, node_name=name, geom_name=name, transform=move)
    pages = mesh.pages if isinstance(mesh, TexturedMesh) else []
    data = [_compress(page, quality) for page in pages]
    images: list[dict[str, Any]] = []

    def put_pages(buffers: Any, tree: dict[str, Any]) -> None:
        keys = list(buffers)
        images.extend(tree["images"])
        for image, page in zip(images, data, strict=True):
            buffers[keys[image["bufferView"]]] = page + bytes(-len(page) % 4)
            image["mimeType"] = "image/jpeg" if quality else "image/png"

    def finish(tree: dict[str, Any]) -> None:
        for image, page in zip(images, data, strict=True):
            tree["bufferViews"][image["bufferView"]]["byteLength"] = len(page)
        _finish(tree)

    content = gltf.export_glb(
        scene, include_normals=False, buffer_postprocessor=put_pages, tree_postprocessor=finish
    )
    with atomic_file(path) as work:
        work.write_bytes(content)


def _split_pages(mesh: TexturedMesh | Mesh) -> list[tuple[int, Index, Index]]:
    """By texture page, the gray one (-1) last: indices of the vertices, and faces of these."""
    if not len(mesh):
        raise ValueError("a mesh without faces")
    of_face = mesh.page if isinstance(mesh, TexturedMesh) else np.full(len(mesh), -1, np.int32)
    parts = []
    for page in sorted(np.unique(of_face).tolist(), key=lambda number: (number < 0, number)):
        used, faces = np.unique(mesh.faces[of_face == page], return_inverse=True)
        parts.append((page, used, faces.reshape(-1, 3)))
    return parts


def _y_up(points: Float) -> Float:
    """(..., 3) points with z up in a frame with y up."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def _visual(trimesh: Any, name: str, page: int, uv: Float | None) -> Any:
    """Material and uv of a part: a placeholder image that is unique to the page, or gray."""
    linear = ((GRAY[0] / 255.0 + 0.055) / 1.055) ** 2.4  # as color factors of glTF are
    image = None if uv is None else Image.new("RGB", (1, 1), (page & 255, page >> 8, 0))
    material = trimesh.visual.material.PBRMaterial(
        name=name,
        baseColorTexture=image,
        baseColorFactor=[linear, linear, linear, 1.0] if uv is None else None,
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )
    if uv is not None:
        uv = np.column_stack([uv[:, 0], 1.0 - uv[:, 1]])  # trimesh counts from the bottom
    return trimesh.visual.TextureVisuals(uv=uv, material=material)


def _compress(page: NDArray[np.uint8], quality: int) -> bytes:
    """A texture page as JPEG of a quality, or as PNG where it is 0."""
    out = io.BytesIO()
    # colours at full resolution: charts have sharp edges
    options = {"quality": quality, "subsampling": 0} if quality else {}
    Image.fromarray(page).save(out, "JPEG" if quality else "PNG", **options)
    return out.getvalue()


def _finish(tree: dict[str, Any]) -> None:
    """Adds samplers, unlit textures and buffer targets; without normals shading is flat."""
    tree["asset"]["generator"] = "stillmap"
    if tree.get("textures"):
        sampler = {"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP_LINEAR}
        tree["samplers"] = [{**sampler, "wrapS": _CLAMP_TO_EDGE, "wrapT": _CLAMP_TO_EDGE}]
        for texture in tree["textures"]:
            texture["sampler"] = 0
    for material in tree["materials"]:
        if "baseColorTexture" in material["pbrMetallicRoughness"]:
            material["extensions"] = {"KHR_materials_unlit": {}}
            tree["extensionsUsed"] = ["KHR_materials_unlit"]
    for mesh in tree["meshes"]:
        del mesh["extras"]
        for primitive in mesh["primitives"]:
            used = [(primitive["indices"], _INDICES)]
            used += [(accessor, _VERTICES) for accessor in primitive["attributes"].values()]
            for accessor, target in used:
                view = tree["accessors"][accessor]["bufferView"]
                tree["bufferViews"][view]["target"] = target


# from a model's frame, y up, to the map frame, z up
MAP_FROM_GLTF: Float = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])

_HEAD = struct.Struct("<4sII")  # magic, version, length of all


def read_glb(path: Path, most: int) -> bytes:
    """The bytes of a .glb file of at most `most` bytes.

    What it refers to elsewhere is not loaded: the policy of the viewer's page forbids it.

    Raises:
        InputError: it is missing, too large, or damaged.
    """
    data = read_bytes(path, most)
    if data[: _HEAD.size] != _HEAD.pack(b"glTF", 2, len(data)):
        raise InputError("is no complete .glb file", where=str(path))
    return data
