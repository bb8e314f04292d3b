"""Extensions and first bytes of the point cloud formats: all that is needed to detect them.

The readers themselves are loaded only for a file of their format.
"""

from collections.abc import Iterator
from pathlib import Path

E57_EXTENSIONS, E57_MAGIC = (".e57",), b"ASTM-E57"
LAS_EXTENSIONS, LAS_MAGIC = (".las", ".laz"), b"LASF"
PCD_EXTENSIONS = (".pcd",)
PLY_EXTENSIONS = (".ply",)
THREEDTK_EXTENSIONS = (".3d", ".3d.gz")

MAX_PCD_HEADER = 1 << 14  # bytes


def is_pcd(head: bytes) -> bool:
    """Whether the first bytes of a file are a PCD header."""
    for line in head[:MAX_PCD_HEADER].splitlines():
        words = line.split()
        if words and not words[0].startswith(b"#"):
            return words[0] in (b"VERSION", b"FIELDS")
        if words[1:2] == [b".PCD"] or words[:1] == [b"#.PCD"]:
            return True
    return False


def is_e57(head: bytes) -> bool:
    """Whether a file with these first bytes is an E57 file."""
    return head.startswith(E57_MAGIC)


def is_las(head: bytes) -> bool:
    """Whether a file with these first bytes is a LAS or LAZ file."""
    return head.startswith(LAS_MAGIC)


def is_ply(head: bytes) -> bool:
    """Whether a file with these first bytes is a PLY file."""
    return head.startswith((b"ply\n", b"ply\r"))


def has_extension(path: Path, extensions: tuple[str, ...]) -> bool:
    """Whether a file has one of the extensions, in any case, and is not hidden."""
    return path.name.lower().endswith(extensions) and not path.name.startswith(".")


def contains_files(folder: Path, extensions: tuple[str, ...]) -> bool:
    """Whether a folder has files of these extensions; False where it cannot be read."""
    try:
        return any(iter_files(folder, extensions))
    except OSError:
        return False


def iter_files(folder: Path, extensions: tuple[str, ...]) -> Iterator[Path]:
    """Yield the files of a folder with one of the extensions, in the order of the system."""
    return (e for e in folder.iterdir() if has_extension(e, extensions) and not e.is_dir())
