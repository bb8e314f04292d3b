"""Writes meshes as binary glTF and OBJ (y up), and reads self-contained glTF files.

trimesh writes the files with 1 x 1 placeholder images, which are replaced by compressed pages.
"""

import io
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stillmap.core.errors import InputError, import_extra
from stillmap.core.files import atomic_file, atomic_folder, require_regular
from stillmap.mesh.texture.atlas import GRAY, TexturedMesh
from stillmap.mesh.triangle_mesh import Mesh

Float = NDArray[np.float64]

_LINEAR, _LINEAR_MIPMAP_LINEAR, _CLAMP_TO_EDGE = 9729, 9987, 33071  # of glTF samplers
_VERTICES, _INDICES = 34962, 34963  # targets of glTF buffer views
_FAR = 1000.0  # m, coordinates from which on 32-bit floats are coarse


class Page(NamedTuple):
    """A compressed texture page."""

    suffix: str
    kind: str
    data: bytes


class Part(NamedTuple):
    """The faces of one page, or the gray ones (page -1), with their own vertices."""

    page: int
    vertices: Float
    faces: NDArray[np.int64]
    uv: Float


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
    trimesh = _trimesh(path)
    pages = _compressed(mesh, quality)
    parts = _parts(mesh)
    shift = np.zeros(3)
    if max(np.abs(part.vertices).max() for part in parts) > _FAR:
        shift = np.rint(np.mean([part.vertices.mean(axis=0) for part in parts], axis=0))
    move = np.eye(4)
    move[:3, 3] = _y_up(shift)
    scene = trimesh.Scene()
    for part in parts:
        name, visual = _name(part.page), trimesh.visual.TextureVisuals
        material = _material(trimesh, part.page)
        made = trimesh.Trimesh(
            _y_up(part.vertices - shift),
            part.faces,
            visual=visual(uv=flip_v(part.uv) if part.page >= 0 else None, material=material),
            process=False,
        )
        scene.add_geometry(made, node_name=name, geom_name=name, transform=move)
    images: list[dict[str, Any]] = []

    def put_pages(buffers: Any, tree: dict[str, Any]) -> None:
        keys = list(buffers)
        images.extend(tree["images"])
        for image, page in zip(images, pages, strict=True):
            buffers[keys[image["bufferView"]]] = page.data + bytes(-len(page.data) % 4)
            image["mimeType"] = page.kind

    def finish(tree: dict[str, Any]) -> None:
        for image, page in zip(images, pages, strict=True):
            tree["bufferViews"][image["bufferView"]]["byteLength"] = len(page.data)
        _finish(tree)

    data = trimesh.exchange.gltf.export_glb(
        scene,
        include_normals=False,
        buffer_postprocessor=put_pages,
        tree_postprocessor=finish,
    )
    with atomic_file(path) as work:
        work.write_bytes(data)


def write_obj(folder: Path, mesh: TexturedMesh | Mesh, quality: int = 90) -> None:
    """Writes `mesh.obj`, `mesh.mtl` and `page0.jpg`, ... into a new folder; see `write_glb`.

    Raises:
        InputError: the folder holds something, or cannot be written.
        MissingExtra: trimesh is not installed.
    """
    _trimesh(folder)  # it is the folder that cannot be written without
    files = encode_obj(mesh, quality)
    with atomic_folder(folder, "mesh.obj") as work:
        for name, data in files.items():
            (work / name).write_bytes(data)


def encode_obj(
    mesh: TexturedMesh | Mesh, quality: int, name: str = "mesh", before: str = ""
) -> dict[str, bytes]:
    """The content of `NAME.obj`, `NAME.mtl` and the pages, by file name.

    Args:
        mesh: with one face at least.
        quality: JPEG quality of the pages; 0: PNG.
        name: of the first two.
        before: prefix of the names of pages.

    Raises:
        MissingExtra: trimesh is not installed.
    """
    trimesh = _trimesh(Path(f"{name}.obj"))
    pages = _compressed(mesh, quality)
    simple = trimesh.visual.material.SimpleMaterial
    scene = trimesh.Scene()
    for part in _parts(mesh):  # the gray one last: trimesh expects uv for all before
        title = _name(part.page)
        paint = 255 if part.page >= 0 else GRAY[0]
        material = simple(
            image=_placeholder(part.page) if part.page >= 0 else None,
            diffuse=[paint, paint, paint, 255],
            specular=[0, 0, 0, 255],
        )
        material.name = title
        uv = flip_v(part.uv) if part.page >= 0 else None
        visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
        made = trimesh.Trimesh(_y_up(part.vertices), part.faces, visual=visual, process=False)
        scene.add_geometry(made, node_name=title, geom_name=title)
    materials = f"{name}.mtl"
    text, beside = trimesh.exchange.obj.export_obj(
        scene, include_normals=False, return_texture=True, mtl_name=materials, header=None
    )
    material_text, named = beside[materials].decode("utf-8"), {}
    for number, page in enumerate(pages):
        file = f"{before}{_name(number)}{page.suffix}"
        material_text = material_text.replace(f"map_Kd {_name(number)}.png\n", f"map_Kd {file}\n")
        named[file] = page.data
    return {f"{name}.obj": text.encode("utf-8"), materials: material_text.encode("utf-8"), **named}


def _trimesh(path: Path) -> Any:
    for name in ("trimesh.exchange.gltf", "trimesh.exchange.obj", "trimesh.visual.material"):
        import_extra(name, path, "written", group="mesh")
    return import_extra("trimesh", path, "written", group="mesh")


def _parts(mesh: TexturedMesh | Mesh) -> list[Part]:
    """Parts by page, the gray one last."""
    if not len(mesh):
        raise ValueError("a mesh without faces")
    uv_of_all = mesh.uv if isinstance(mesh, TexturedMesh) else np.zeros((len(mesh.vertices), 2))
    of_face = mesh.page if isinstance(mesh, TexturedMesh) else np.full(len(mesh), -1, np.int32)
    parts = []
    for page in sorted(np.unique(of_face).tolist(), key=lambda number: (number < 0, number)):
        used, faces = np.unique(mesh.faces[of_face == page], return_inverse=True)
        parts.append(Part(page, mesh.vertices[used], faces.reshape(-1, 3), uv_of_all[used]))
    return parts


def _name(page: int) -> str:
    return f"page{page}" if page >= 0 else "grey"


def _y_up(points: Float) -> Float:
    """(..., 3) points with z up in a frame with y up."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def to_z_up(points: Float) -> Float:
    """(..., 3) points with y up in a frame with z up."""
    return np.stack([points[..., 0], -points[..., 2], points[..., 1]], axis=-1)


def flip_v(uv: Float) -> Float:
    """uv counted from the bottom, as in trimesh and OBJ."""
    return np.column_stack([uv[:, 0], 1.0 - uv[:, 1]])


def _placeholder(page: int) -> Image.Image:
    """A placeholder image that is unique to a page."""
    return Image.new("RGB", (1, 1), (page & 255, page >> 8, 0))


def _material(trimesh: Any, page: int) -> Any:
    """Material of a page, or gray; color factors are linear in glTF."""
    linear = ((GRAY[0] / 255.0 + 0.055) / 1.055) ** 2.4
    return trimesh.visual.material.PBRMaterial(
        name=_name(page),
        baseColorTexture=_placeholder(page) if page >= 0 else None,
        baseColorFactor=None if page >= 0 else [linear, linear, linear, 1.0],
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )


def _compressed(mesh: TexturedMesh | Mesh, quality: int) -> list[Page]:
    return list(_each_compressed(mesh, quality)) if isinstance(mesh, TexturedMesh) else []


def _each_compressed(mesh: TexturedMesh, quality: int) -> Iterator[Page]:
    for page in mesh.pages:
        out = io.BytesIO()
        if quality:
            # colours at full resolution: charts have sharp edges
            Image.fromarray(page).save(out, "JPEG", quality=quality, subsampling=0)
            yield Page(".jpg", "image/jpeg", out.getvalue())
        else:
            Image.fromarray(page).save(out, "PNG")
            yield Page(".png", "image/png", out.getvalue())


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
MAP_FROM_GLTF: NDArray[np.float64] = np.array(
    [[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
)

_MAGIC, _JSON = b"glTF", b"JSON"

_HEAD = struct.Struct("<4sII")  # magic, version, length of all

_CHUNK = struct.Struct("<I4s")  # length, kind

_MAX_JSON = 64 << 20

# viewers fetch its decoder from elsewhere
_PACKED = "KHR_draco_mesh_compression"


def read_glb(path: Path, most: int) -> bytes:
    """The bytes of a self-contained .glb file of at most `most` bytes.

    Raises:
        InputError: it is missing, too large, damaged, or refers to other files.
    """
    require_regular(path)
    if path.stat().st_size > most:
        raise InputError(f"is larger than {most >> 20} MiB", where=str(path))
    data = path.read_bytes()
    try:
        document = _document(data)
    except (ValueError, RecursionError, struct.error) as error:
        raise InputError(f"is no complete .glb file: {error}", where=str(path)) from error
    for uri in _uris(document):
        if not (isinstance(uri, str) and uri.startswith("data:")):
            raise InputError("refers to another file: it is not shown", where=str(path))
    if _PACKED in document.get("extensionsUsed", []):
        raise InputError(f"uses {_PACKED}: it is not shown", where=str(path))
    return data


def _document(data: bytes) -> dict[str, Any]:
    magic, version, length = _HEAD.unpack_from(data)
    size, kind = _CHUNK.unpack_from(data, _HEAD.size)
    start = _HEAD.size + _CHUNK.size
    if magic != _MAGIC or version != 2 or length != len(data):
        raise ValueError("its header is not that of glTF 2")
    if kind != _JSON or size > min(len(data) - start, _MAX_JSON):
        raise ValueError("its first chunk is not JSON")
    document = json.loads(data[start : start + size].decode("utf-8"))
    if not isinstance(document, dict):
        raise ValueError("its JSON is no object")
    return document


def _uris(document: object) -> Iterator[object]:
    """Every `uri` of a document."""
    rest = [document]
    while rest:
        one = rest.pop()
        if isinstance(one, dict):
            rest.extend(one.values())
            if "uri" in one:
                yield one["uri"]
        elif isinstance(one, list):
            rest.extend(one)
