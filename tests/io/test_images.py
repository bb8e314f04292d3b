"""Errors on images that cannot be read."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from peak_memory import run_measured
from PIL import Image, ImageFile

from stillmap.core.errors import InputError
from stillmap.io.cameras import read_image, read_image_size

READ = """
import sys
from pathlib import Path
from stillmap.io.cameras import read_image
read_image(Path(sys.argv[1]))
"""


@pytest.fixture
def picture(tmp_path) -> Path:
    """One of noise, which does not pack well."""
    path = tmp_path / "a.png"
    noise = np.random.default_rng(0).integers(0, 255, (32, 32, 3)).astype(np.uint8)
    Image.fromarray(noise).save(path)
    return path


def said(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_image(path)
    return str(caught.value)


def test_a_picture_that_is_damaged_or_gone(picture):
    picture.write_bytes(picture.read_bytes()[:1000])
    assert read_image_size(picture) == (32, 32)
    assert said(picture) == f"{picture}: is no image, or damaged"
    picture.write_bytes(b"nothing")
    assert said(picture) == f"{picture}: is no image, or damaged"
    picture.unlink()
    assert said(picture) == f"{picture}: cannot be read: No such file or directory"
    picture.mkdir()
    assert said(picture) == f"{picture}: cannot be read: it is a folder"


def test_a_picture_that_nobody_may_read(picture, monkeypatch):
    """Root may read nearly everything."""

    def denied(path, *_, **__):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Image, "open", denied)
    assert said(picture) == f"{picture}: cannot be read: Permission denied"


def test_a_picture_that_wants_all_memory_is_damaged(picture, monkeypatch):
    def load(_):
        raise MemoryError

    monkeypatch.setattr(ImageFile.ImageFile, "load", load)
    assert said(picture) == f"{picture}: is no image, or damaged"


def test_a_small_file_does_not_unpack_to_a_gigabyte(tmp_path):
    """67 million pixels at most; Pillow itself allows 89 million, a gigabyte with all copies."""
    path = tmp_path / "wide.png"
    Image.new("P", (8300, 8200)).save(path)
    assert path.stat().st_size < 1 << 20
    assert said(path) == f"{path}: is too large an image"
    with pytest.raises(InputError, match="is too large an image"):
        read_image_size(path)


@pytest.mark.parametrize("mode", ["L", "I;16", "I", "F", "RGB", "RGBA", "P", "1"])
def test_images_are_unpacked_some_rows_at_a_time(mode, tmp_path, monkeypatch):
    """Every pixel of every kind comes where it was."""
    rng = np.random.default_rng(1)
    grey = rng.integers(0, 255, (37, 23)).astype(np.uint8)
    image = Image.fromarray(grey.astype(np.uint16) if mode == "I;16" else grey)
    path = tmp_path / "a.tif"
    image.convert(mode).save(path)
    monkeypatch.setattr("stillmap.io.cameras._UNPACKED", 100)
    whole = np.array(image.convert("1") if mode == "1" else image)
    expected = whole if mode in ("L", "I;16", "I", "F") else np.repeat(whole[..., None], 3, axis=2)
    np.testing.assert_array_equal(
        read_image(path), expected.astype(np.uint8) * 255 if mode == "1" else expected
    )


def test_the_largest_image_with_transparency_takes_half_a_gigabyte(tmp_path):
    """Two images and the list of their parts took twice as much."""
    path = tmp_path / "a.png"
    Image.new("RGBA", (8192, 8192)).save(path, compress_level=1)
    _, megabytes = run_measured(READ, path)
    assert megabytes < 700


@pytest.mark.parametrize("format", ["EPS", "TGA", "GIF", "PCX"])
def test_other_formats_are_refused_whatever_the_name(format, picture, monkeypatch):
    """To read EPS, Pillow starts Ghostscript."""

    def start(*_, **__):
        raise AssertionError("a program was started")

    monkeypatch.setattr(subprocess, "Popen", start)
    image = Image.open(picture)
    image.load()
    image.convert("P" if format == "GIF" else "RGB").save(picture, format=format)
    assert said(picture) == f"{picture}: is no image, or damaged"
