"""Export the mesh of a result as OBJ."""

import io
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core.errors import InputError, import_extra
from stillmap.core.files import atomic_file, require_new_file
from stillmap.mesh.texture.atlas import TexturedMesh
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.mesh.types import Image
from stillmap.results.gltf import encode_obj, flip_v, read_glb, to_z_up
from stillmap.results.reader import require_model

ENDING = ".obj"

_MAX_BYTES = 2 << 30
_PAGE = "page"


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
        textured = name.startswith(_PAGE)
        uv.append(flip_v(part.visual.uv) if textured else np.zeros((len(part.vertices), 2)))
        page.append(np.full(len(part.faces), len(pages) if textured else -1, np.int32))
        if textured:
            pages.append(np.asarray(part.visual.material.baseColorTexture.convert("RGB")))
    points, corners = np.concatenate(vertices), np.concatenate(faces)
    if not np.isfinite(points).all():
        raise ValueError("a vertex that is not finite")
    if not pages:
        return Mesh(points, corners)
    none = np.full(len(corners), -1, np.int32), np.full(count, -1, np.int32)
    return TexturedMesh(
        points, corners, np.concatenate(uv), np.concatenate(page), tuple(pages), *none
    )


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
