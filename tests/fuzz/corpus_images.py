"""Seeds of fuzzing: RGB-D folders and camera files."""

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from parts import join_parts
from PIL import Image

SCENES = (
    *("frame-000000.depth.png", "frame-000000.color.png", "frame-000000.pose.txt"),
    *("frame-000001.depth.png", "frame-000001.color.png", "frame-000001.pose.txt"),
    "camera-intrinsics.txt",
)
TUM = (
    *("depth.txt", "rgb.txt", "groundtruth.txt"),
    *("depth/0.png", "depth/1.png", "rgb/0.png", "camera.txt"),
)


def _make_images() -> tuple[list[bytes], list[bytes]]:
    """Two depth and two color images, as PNG."""
    rng = np.random.default_rng(5)
    out: tuple[list[bytes], list[bytes]] = ([], [])
    for values in (rng.integers(900, 1100, (12, 16)), rng.integers(0, 255, (12, 16, 3))):
        for k in range(2):
            stream = io.BytesIO()
            kind = np.uint16 if values.ndim == 2 else np.uint8
            Image.fromarray((values + k).astype(kind)).save(stream, format="PNG")
            out[values.ndim - 2].append(stream.getvalue())
    return out


def scenes(work: Path) -> Iterator[bytes]:  # noqa: ARG001
    depth, color = _make_images()
    pose = b"0 0 1 0\n-1 0 0 0\n0 -1 0 0.5\n0 0 0 1\n"
    each = [part for k in range(2) for part in (depth[k], color[k], pose)]
    yield join_parts([*each, b"20 0 7.5\n0 20 5.5\n0 0 1\n"])


def tum(work: Path) -> Iterator[bytes]:  # noqa: ARG001
    depth, color = _make_images()
    lists = (b"# a\n1.5 depth/0.png\n1.6 depth/1.png\n", b"1.5 rgb/0.png\n")
    poses = b"# t\n1.45 0 0 1 0 0 0 1\n1.65 0.1 0 1 0 0 0 1\n"
    yield join_parts([*lists, poses, *depth, color[0], b"20 0 7.5\n0 20 5.5\n0 0 1\n"])


def cameras(work: Path) -> Iterator[bytes]:  # noqa: ARG001
    yield (
        b'[color]\nK = [[20, 0, 7.5], [0, 20, 5.5], [0, 0, 1]]\nmodel = "plumb_bob"\n'
        b"distortion = [-0.1, 0.01, 0, 0, 0]\ntranslation = [0, 0.1, 0]\nrpy = [0, 0, 1.5]\n"
        b"time_offset = -0.5\n"
    )
    yield (
        b"[color]\nfx = 20\nfy = 20\ncx = 7.5\ncy = 5.5\nwidth = 16\nheight = 12\n"
        b"translation = [0, 0, 0]\nquaternion = [-0.5, 0.5, -0.5, 0.5]\n"
        b'[more]\nfolder = "more"\ntimes = "times.txt"\nmodel = "equidistant"\n'
        b"distortion = [0.1, 0, 0, 0]\n"
        b"T_base_camera = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
    )
