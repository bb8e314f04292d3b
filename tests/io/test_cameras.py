"""Files that say of cameras what recordings do not."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from stillmap.cli.recording_info import summarize_recording
from stillmap.core.errors import InputError
from stillmap.io import read
from stillmap.io.cameras import read_camera_file as read_file
from stillmap.prepare.options import ReadOptions

ROW = "1 0 0 0 0 1 0 0 0 0 1 0\n"
LENS = "fx = 20.0\nfy = 21\ncx = 7.5\ncy = 5.5\n"
OF_LEFT = r"\(camera 'left' of .*cameras\.toml\)"
AHEAD = "translation = [0.2, 0, 0.5]\nquaternion = [-0.5, 0.5, -0.5, 0.5]\n"


@pytest.fixture
def file(tmp_path):
    """Writes a camera file."""

    def write(text: str):
        path = tmp_path / "cameras.toml"
        path.write_text(text)
        return path

    return write


@pytest.fixture
def drive(tmp_path):
    """Four sweeps a tenth of a second apart, with pictures of a camera without calibration."""
    folder = tmp_path / "drive"
    for name in ("velodyne", "image_2"):
        (folder / name).mkdir(parents=True)
    for k in range(4):
        sweep = np.full((5, 4), 2.0 + k, "<f4")
        sweep.tofile(folder / "velodyne" / f"{k:06d}.bin")
        Image.fromarray(np.full((12, 16, 3), k, np.uint8)).save(folder / f"image_2/{k:06d}.png")
    (folder / "times.txt").write_text("".join(f"{100 + k / 10}\n" for k in range(4)))
    return folder


@pytest.fixture
def more(tmp_path):
    """Three pictures in a folder, of which a file has the times."""
    (tmp_path / "left").mkdir()
    for k in range(3):
        Image.fromarray(np.full((6, 8), 100 + k, np.uint8)).save(tmp_path / f"left/p{k}.png")
    (tmp_path / "left.txt").write_text("100.05\n100.15\n100.25\n")
    return tmp_path / "left"


def with_cameras(drive, path):
    return read(drive, ReadOptions(cameras=str(path)))


def test_what_a_recording_lacks(drive, file):
    plain = read(drive)
    assert plain.images.cameras[0].K is None
    assert summarize_recording(plain)["images"]["usable"] == 0
    assert summarize_recording(plain)["images"]["left_out"] == {"a camera without calibration": 4}
    text = f'model = "plumb_bob"\ndistortion = [-0.1, 0.01, 0.001, 0]\n{AHEAD}'
    found = with_cameras(drive, file(f"[image_2]\n{LENS}{text}"))
    (camera,) = found.images.cameras
    assert (camera.name, camera.width, camera.height) == ("image_2", 16, 12)
    np.testing.assert_array_equal(camera.K, [[20, 0, 7.5], [0, 21, 5.5], [0, 0, 1]])
    assert camera.model == "plumb_bob"
    np.testing.assert_array_equal(camera.distortion, [-0.1, 0.01, 0.001, 0.0])
    T = [[0, 0, 1, 0.2], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]]
    np.testing.assert_allclose(camera.T_base_camera, T, atol=1e-12)
    np.testing.assert_array_equal(found.images.stamp_ns, plain.images.stamp_ns)
    assert summarize_recording(found)["images"]["usable"] == 4
    assert summarize_recording(found)["images"]["cameras"][0]["usable"] == 4


def test_it_goes_before_what_the_recording_says(drive, file):
    (drive / "calib.txt").write_text(f"P2: {ROW}Tr: {ROW}")
    found = with_cameras(drive, file(f"[image_2]\n{LENS}"))
    (camera,) = found.images.cameras
    assert camera.K[0, 0] == 20.0
    np.testing.assert_array_equal(camera.T_base_camera, np.eye(4))


def test_a_clock_that_is_off(drive, file):
    found = with_cameras(drive, file("[image_2]\ntime_offset = -0.12\n"))
    np.testing.assert_array_equal(found.images.stamp_ns, read(drive).images.stamp_ns - 120_000_000)
    np.testing.assert_array_equal(found.images.read(3)[0, 0], [3, 3, 3])


def test_pictures_beside_the_recording(drive, file, more):
    found = with_cameras(drive, file(f'[left]\nfolder = "left"\ntimes = "left.txt"\n{LENS}{AHEAD}'))
    images = found.images
    assert [camera.name for camera in images.cameras] == ["image_2", "left"]
    assert (images.cameras[1].width, images.cameras[1].height) == (8, 6)
    np.testing.assert_array_equal(images.camera, [0, 1, 0, 1, 0, 1, 0])
    assert [int(images.read(k).flat[0]) for k in range(7)] == [0, 100, 1, 101, 2, 102, 3]
    # a clock that is off puts them elsewhere
    text = f'[left]\nfolder = "{more}"\ntimes = "{more}.txt"\ntime_offset = 0.1\n'
    images = with_cameras(drive, file(text)).images
    np.testing.assert_array_equal(images.camera, [0, 0, 1, 0, 1, 0, 1])
    assert [int(images.read(k).flat[0]) for k in range(7)] == [0, 1, 100, 2, 101, 3, 102]


def test_names_of_pictures_may_be_their_times(drive, file, more):
    for picture in (drive / "image_2").iterdir():
        picture.unlink()
    for k, picture in enumerate(sorted(more.iterdir())):
        picture.rename(more / f"100.{k}5.png")
    found = with_cameras(drive, file('[left]\nfolder = "left"\n'))
    np.testing.assert_array_equal(
        found.images.stamp_ns, [100_050_000_000, 100_150_000_000, 100_250_000_000]
    )
    assert [camera.name for camera in found.images.cameras] == ["left"]
    assert read(drive).images is None


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("[imag_2]\nfx = 1\n", r"there is no camera 'imag_2' \(has: image_2; folder"),
        ('[image_2]\nfolder = "left"\n', "has images in the recording"),
        ('[left]\nfolder = "missing"\n', f"missing: cannot be read: No such file.*{OF_LEFT}"),
        ('[left]\nfolder = "empty"\n', f"empty: holds no images {OF_LEFT}"),
        ('[left]\nfolder = "bad"\n', rf"1\.5\.png: is no image.* {OF_LEFT}"),
        ('[left]\nfolder = "left"\n', "names are no stamps .times = 'FILE' in camera 'left'"),
        ('[left]\nfolder = "left"\ntimes = "no.txt"\n', r"no\.txt: cannot be read|No such file"),
        ('[left]\nfolder = "left"\ntimes = "short.txt"\n', "has 2 stamps for 3 files"),
        ('[left]\nfolder = "left"\ntimes = "words.txt"\n', "stamps for 3 files|no usable stamp"),
        ('[left]\nfolder = "left"\ntimes = "/dev/zero"\n', "is no regular file"),
    ],
)
def test_cameras_and_pictures_that_are_not_there(drive, file, more, text, what):
    (more.parent / "empty").mkdir()
    (more.parent / "bad").mkdir()
    (more.parent / "bad/1.5.png").write_text("no picture")
    (more.parent / "short.txt").write_text("1\n2\n")
    (more.parent / "words.txt").write_text("a\nb\nc\n")
    with pytest.raises(InputError, match=what):
        with_cameras(drive, file(text))


def test_a_recording_without_pictures_says_so(drive, file):
    for picture in (drive / "image_2").iterdir():
        picture.unlink()
    with pytest.raises(InputError, match="has: no images; folder"):
        with_cameras(drive, file("[image_2]\n"))


def test_a_recording_in_2d_has_no_cameras(tmp_path, file):
    (tmp_path / "a.log").write_text("FLASER 2 1.0 2.0 0 0 0 0 0 0 1.5 host 0.5\n")
    with pytest.raises(InputError, match=r"read\.cameras is for 3D recordings"):
        read(tmp_path / "a.log", ReadOptions(cameras=str(file(f"[a]\n{LENS}"))))


REFUSED = [
    ("", "names no camera"),
    ("fx = 3\n", "'fx' stands outside of a camera"),
    ("[a]\nfocal = 3\n", r"camera 'a': unknown option 'focal' \(nearest: '"),
    ("[a]\nfx = 3\n", "'fx', 'fy', 'cx' and 'cy'"),
    ("[a]\nK = [1, 2, 3]\n", "'K' needs 3 x 3 numbers"),
    ("[a]\nK = [[1, 0, 0], [0, 1, 0], [0, 0, 2]]\n", "last row of 'K'"),
    ("[a]\nK = [[0, 0, 0], [0, 1, 0], [0, 0, 1]]\n", "focal lengths must be positive"),
    (f"[a]\nK = [1, 0, 0, 0, 1, 0, 0, 0, 1]\n{LENS}", "give either 'K'"),
    (f"[a]\n{LENS.replace('20.0', 'true')}", "'fx' must be a finite number"),
    (f"[a]\n{LENS.replace('20.0', 'nan')}", "'fx' must be a finite number"),
    ("[a]\nwidth = 3\n", "go together"),
    ("[a]\nwidth = 0\nheight = 3\n", "'width' must be at least 1"),
    ('[a]\nmodel = "fisheye"\n', "'model' must be '' or 'plumb_bob'"),
    ("[a]\ndistortion = [1, 2, 3, 4]\n", "'distortion' needs 'model'"),
    ('[a]\nmodel = "equidistant"\ndistortion = [1]\n', "'equidistant' needs 4 numbers, got 1"),
    ('[a]\nmodel = "plumb_bob"\n', "'plumb_bob' needs 4 or 5 numbers, got 0"),
    (f"[a]\n{AHEAD}rpy = [0, 0, 0]\n", "needs 'translation', and one of"),
    ("[a]\ntranslation = [0, 0, 0]\nquaternion = [0, 0, 0, 2]\n", "not of norm one"),
    ("[a]\nT_base_camera = [1]\n", "'T_base_camera' needs 4 x 4 numbers"),
    (
        "[a]\nT_base_camera = [2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n",
        "no rotation matrix",
    ),
    ("[a]\nT_base_camera = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 1, 1]\n", "last row of"),
    ('[a]\ntimes = "b"\n', "'times' is for a 'folder'"),
    ('[a]\nfolder = "\\u0000"\n', "'folder'"),
    ("[a\n", "is not TOML"),
]


@pytest.mark.parametrize(("text", "what"), REFUSED)
def test_what_is_wrong_is_named_with_the_file(file, text, what):
    with pytest.raises(InputError, match=what) as error:
        read_file(file(text))
    assert "cameras.toml" in error.value.where


def test_ways_to_write_a_place(file):
    turn = Rotation.from_euler("ZYX", [0.3, 0.2, -1.5]).as_matrix()
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn, (1.0, 2.0, 3.0)
    rows = str(T.tolist())
    flat = str(T.ravel().tolist())
    text = f"[a]\nT_base_camera = {rows}\n[b]\nT_base_camera = {flat}\n"
    text += "[c]\ntranslation = [1, 2, 3]\nrpy = [-1.5, 0.2, 0.3]\n[d]\n"
    found = read_file(file(text))
    for name in "abc":
        np.testing.assert_allclose(found[name].pose(), T, atol=1e-12)
    assert found["d"].T_base_camera is None
