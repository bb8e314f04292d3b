"""The model in a result, as OBJ."""

import io
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core.errors import InputError, import_extra
from stillmap.core.files import atomic_file, require_new_file
from stillmap.mesh.texture.atlas import Image, TexturedMesh
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.results.gltf import encode_obj, flip_v, read_glb, to_z_up
from stillmap.results.reader import require_model

ENDING = ".obj"

_MOST = 2 << 30  # bytes
_PAGE = "page"


def read_model(path: Path) -> TexturedMesh | Mesh:
    """A model that stillmap wrote, z up.

    Raises:
        InputError: it is missing or damaged.
        MissingExtra: trimesh is not installed.
    """
    trimesh = import_extra("trimesh", path, group="mesh")
    data = read_glb(path, _MOST)
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)
        return _model(scene)
    except MemoryError:
        raise
    except Exception as error:  # whatever trimesh, NumPy or Pillow say of what is no such file
        raise InputError(f"is damaged: {error!r}", where=str(path)) from error


def _model(scene: Any) -> TexturedMesh | Mesh:
    vertices, faces, uv, page, count = [], [], [], [], 0
    pages: list[Image] = []
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph[node]
        part = scene.geometry[name]
        vertices.append(to_z_up(np.asarray(part.vertices, np.float64) @ T[:3, :3].T + T[:3, 3]))
        faces.append(np.asarray(part.faces, np.int32) + count)
        count += len(part.vertices)
        painted = name.startswith(_PAGE)
        uv.append(flip_v(part.visual.uv) if painted else np.zeros((len(part.vertices), 2)))
        page.append(np.full(len(part.faces), len(pages) if painted else -1, np.int32))
        if painted:
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
    """Writes the model in a result as `NAME.obj`, with `NAME.mtl` and `NAME_page0.jpg`, ... beside.

    All of them are whole before the first appears, and the `.obj` is the last.

    Args:
        folder: what `stillmap map` wrote.
        output: NAME.obj.
        quality: of the pages as JPEG; 0: PNG.
        overwrite: replace what is there.

    Returns:
        How many faces and pages there are.

    Raises:
        InputError: there is no model, or a file is in the way or cannot be written.
        MissingExtra: trimesh is not installed.
    """
    require_new_file(output, overwrite)
    model = read_model(require_model(folder))
    files = encode_obj(model, quality, output.stem, f"{output.stem}_")
    named = {output.with_name(name): data for name, data in files.items()}
    for one in named:
        require_new_file(one, overwrite)
    with ExitStack() as all_of_them:  # what is entered first appears last
        for one, data in named.items():
            all_of_them.enter_context(atomic_file(one)).write_bytes(data)
    return len(model), len(model.pages) if isinstance(model, TexturedMesh) else 0
