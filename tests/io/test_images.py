"""Errors on images that cannot be read."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stillmap.core.errors import InputError
from stillmap.io.images import read_image, read_image_size


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


def test_what_is_no_picture_is_named_once(picture):
    picture.write_bytes(b"nothing")
    assert said(picture) == f"{picture}: is no image"


def test_a_picture_that_is_cut(picture):
    picture.write_bytes(picture.read_bytes()[:1000])
    assert read_image_size(picture) == (32, 32)
    assert said(picture).startswith(f"{picture}: is no image: ")
    assert said(picture).count(picture.name) == 1


def test_a_picture_that_is_gone(picture):
    picture.unlink()
    assert said(picture) == f"{picture}: is listed, but not there"
    picture.mkdir()
    assert said(picture) == f"{picture}: is no file"


def test_a_picture_that_nobody_may_read(picture, monkeypatch):
    """Root may read nearly everything."""

    def denied(path, *_, **__):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Image, "open", denied)
    assert said(picture) == f"{picture}: cannot be read: Permission denied"
    monkeypatch.setattr(Path, "is_file", denied)
    assert said(picture) == f"{picture}: cannot be read: Permission denied"


def test_a_small_file_does_not_unpack_to_a_gigabyte(tmp_path):
    """67 million pixels at most; Pillow itself allows 89 million, a gigabyte with all copies."""
    path = tmp_path / "wide.png"
    Image.new("P", (8300, 8200)).save(path)
    assert path.stat().st_size < 1 << 20
    assert said(path) == f"{path}: is too large an image"
    with pytest.raises(InputError, match="is too large an image"):
        read_image_size(path)
