"""`stillmap filter` of folders of RGB-D cameras."""

import numpy as np
import pytest
from labelled import RNG, files, label, run
from refusals import refused


@pytest.mark.parametrize("layout", ["scenes", "tum"])
@pytest.mark.parametrize("step", [1, 2, 3])
def test_depth_images(call, tmp_path, layout, step):
    """Depth becomes zero in the nearest pixels of blanked beams; text in PNG files is kept."""
    from PIL import Image, PngImagePlugin

    folder = tmp_path / "rgbd"
    (folder / "depth").mkdir(parents=True)
    depth = RNG.integers(500, 4000, (3, 13, 20)).astype(np.uint16)
    depth[:, 2, 3], depth[:, 4, :] = 65535, 0
    text = PngImagePlugin.PngInfo()
    text.add_text("camera", "a depth camera")
    names = [f"frame-{k:06d}.depth.png" for k in range(4)]
    if layout == "tum":
        names = [f"depth/{k}.png" for k in range(4)]
        lines = (f"{k}.0 {name}\n" for k, name in enumerate(names))
        (folder / "depth.txt").write_text("# by hand\n" + "".join(lines))
    for k, name in zip((0, 1, 3), names[:2] + names[3:], strict=True):
        Image.fromarray(depth[min(k, 2)]).save(folder / name, pnginfo=text)
    (folder / names[2]).write_bytes(b"\x89PNG\r\n\x1a\n no image")
    (folder / "frame-000000.color.jpg").write_bytes(b"a picture")
    recording, blank = label(folder, tmp_path / "out", options={"depth_step": step})
    assert run(call, tmp_path / "out", tmp_path / "clean")["scans_left_out"] == 1
    before, after = files(folder), files(tmp_path / "clean")
    assert set(before) == set(after)
    rows, columns = np.indices((13, 20))
    grid = -(-13 // step), -(-20 // step)
    nearest = [
        np.minimum((index + step // 2) // step, count - 1)
        for index, count in zip((rows, columns), grid, strict=True)
    ]
    for scan, (k, name) in enumerate(zip((0, 1, 3), names[:2] + names[3:], strict=True)):
        old = depth[min(k, 2)]
        gone = blank[recording.beams_of(scan)].reshape(grid)[tuple(nearest)]
        gone &= (old > 0) & (old < 65535)
        with Image.open(tmp_path / "clean" / name) as image:
            assert image.text == {"camera": "a depth camera"}
            np.testing.assert_array_equal(np.array(image), np.where(gone, 0, old))
        del before[name], after[name]
    with Image.open(tmp_path / "clean" / names[2]) as image:
        assert not np.array(image).any()
        assert np.array(image).shape == (13, 20)
    del before[names[2]], after[names[2]]
    assert before == after


def test_depth_images_of_other_kinds(call, tmp_path):
    from PIL import Image

    (tmp_path / "rgbd/depth").mkdir(parents=True)
    (tmp_path / "rgbd/depth.txt").write_text("1.0 depth/1.tif\n")
    Image.fromarray(np.full((8, 9), 900, np.uint16)).save(tmp_path / "rgbd/depth/1.tif")
    label(tmp_path / "rgbd", tmp_path / "out")
    refused(call("filter", tmp_path / "out", "-o", tmp_path / "clean"), "1.tif", "must be PNG")
