"""Extensions and first bytes of the point cloud formats: all that is needed to detect them.

The readers themselves are loaded only for a file of their format.
"""

E57_EXTENSIONS, E57_MAGIC = (".e57",), b"ASTM-E57"
LAS_EXTENSIONS, LAS_MAGIC = (".las", ".laz"), b"LASF"
PCD_EXTENSIONS = (".pcd",)
PLY_EXTENSIONS = (".ply",)
THREEDTK_EXTENSIONS = (".3d", ".3d.gz")

MAX_PCD_HEADER = 1 << 14  # bytes


def is_pcd(head: bytes) -> bool:
    """True if the first bytes of a file are a PCD header."""
    for line in head[:MAX_PCD_HEADER].splitlines():
        words = line.split()
        if words and not words[0].startswith(b"#"):
            return words[0] in (b"VERSION", b"FIELDS")
        if words[1:2] == [b".PCD"] or words[:1] == [b"#.PCD"]:
            return True
    return False


def is_e57(head: bytes) -> bool:
    """True if a file with these first bytes is an E57 file."""
    return head.startswith(E57_MAGIC)


def is_las(head: bytes) -> bool:
    """True if a file with these first bytes is a LAS or LAZ file."""
    return head.startswith(LAS_MAGIC)


def is_ply(head: bytes) -> bool:
    """True if a file with these first bytes is a PLY file."""
    return head.startswith((b"ply\n", b"ply\r"))
