"""Export the mesh of a result as OBJ."""

import io
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core.errors import InputError, import_extra
from stillmap.core.files import atomic_file, require_new_file
from stillmap.mesh.texture.atlas import GRAY, TexturedMesh
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.mesh.types import Image
from stillmap.results.gltf import (
    compress_pages,
    flip_v,
    import_trimesh,
    make_scene,
    page_name,
    placeholder,
    read_glb,
    to_z_up,
)
from stillmap.results.reader import require_model

ENDING = ".obj"

_MAX_BYTES = 2 << 30


def read_model(path: Path) -> TexturedMesh | Mesh:
    """Read a `.glb` file written by stillmap; z is up.

    Raises:
        InputError: it is missing or damaged.
        MissingExtra: trimesh is not installed.
    """
    trimesh = import_extra("trimesh", path, group="mesh")
    data = read_glb(path, _MAX_BYTES)
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)
        return _mesh_from_scene(scene)
    except MemoryError:
        raise
    except Exception as error:  # of trimesh, NumPy or Pillow, for a damaged file
        raise InputError(f"is damaged: {error!r}", where=str(path)) from error


def _mesh_from_scene(scene: Any) -> TexturedMesh | Mesh:
    vertices, faces, uv, page, count = [], [], [], [], 0
    pages: list[Image] = []
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph[node]
        part = scene.geometry[name]
        vertices.append(to_z_up(np.asarray(part.vertices, np.float64) @ T[:3, :3].T + T[:3, 3]))
        faces.append(np.asarray(part.faces, np.int32) + count)
        count += len(part.vertices)
        textured = name.startswith("page")
        uv.append(flip_v(part.visual.uv) if textured else np.zeros((len(part.vertices), 2)))
        page.append(np.full(len(part.faces), len(pages) if textured else -1, np.int32))
        if textured:
            pages.append(np.asarray(part.visual.material.baseColorTexture.convert("RGB")))
    points, corners = np.concatenate(vertices), np.concatenate(faces)
    if not np.isfinite(points).all():
        raise ValueError("a vertex that is not finite")
    if not pages:
        return Mesh(points, corners)
    view = np.full(len(corners), -1, np.int32)
    return TexturedMesh(
        points, corners, np.concatenate(uv), np.concatenate(page), tuple(pages), view
    )


def encode_obj(
    mesh: TexturedMesh | Mesh, quality: int, name: str, prefix: str = ""
) -> dict[str, bytes]:
    """The content of `NAME.obj`, `NAME.mtl` and the pages, by file name.

    Args:
        mesh: with one face at least.
        quality: JPEG quality of the pages; 0: PNG.
        name: of the first two.
        prefix: of the names of pages.

    Raises:
        MissingExtra: trimesh is not installed.
    """
    trimesh = import_trimesh(Path(f"{name}.obj"))
    scene, materials = make_scene(trimesh, mesh, _material), f"{name}.mtl"
    text, beside = trimesh.exchange.obj.export_obj(
        scene, include_normals=False, return_texture=True, mtl_name=materials, header=None
    )
    material_text, named = beside[materials].decode("utf-8"), {}
    for number, page in enumerate(compress_pages(mesh, quality)):
        title = page_name(number)
        file = f"{prefix}{title}{page.suffix}"
        material_text = material_text.replace(f"map_Kd {title}.png\n", f"map_Kd {file}\n")
        named[file] = page.data
    texts = {f"{name}.obj": text, materials: material_text}
    # they name files, whose names need not be UTF-8
    return {file: one.encode("utf-8", "surrogateescape") for file, one in texts.items()} | named


def _material(trimesh: Any, page: int) -> Any:
    """Material of a page, or gray."""
    paint = 255 if page >= 0 else GRAY[0]
    material = trimesh.visual.material.SimpleMaterial(
        image=placeholder(page) if page >= 0 else None,
        diffuse=[paint, paint, paint, 255],
        specular=[0, 0, 0, 255],
    )
    material.name = page_name(page)
    return material


def write_obj(folder: Path, output: Path, quality: int, overwrite: bool = False) -> tuple[int, int]:
    """Write the mesh as `NAME.obj`, with `NAME.mtl` and `NAME_page0.jpg`, ... beside it.

    The files appear after all have been written, the `.obj` last.

    Args:
        folder: a result folder.
        output: NAME.obj.
        quality: JPEG quality of the pages; 0: PNG.
        overwrite: replace existing files.

    Returns:
        Number of faces and of pages.

    Raises:
        InputError: there is no mesh, a file exists already or cannot be written.
        MissingExtra: trimesh is not installed.
    """
    require_new_file(output, overwrite)
    model = read_model(require_model(folder))
    files = encode_obj(model, quality, output.stem, f"{output.stem}_")
    named = {output.with_name(name): data for name, data in files.items()}
    for one in named:
        require_new_file(one, overwrite)
    with ExitStack() as stack:  # files appear in reverse order
        for one, data in named.items():
            stack.enter_context(atomic_file(one)).write_bytes(data)
    return len(model), len(model.pages) if isinstance(model, TexturedMesh) else 0
