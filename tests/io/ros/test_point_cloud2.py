"""Point clouds and images in bags."""

import io

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from small_bags import DOUBLE, FLOAT, SECOND, START, UINT16, UINT32, cloud_message

from stillmap.core.errors import InputError
from stillmap.io import read
from stillmap.io.ros import clouds as cloud_module
from stillmap.prepare.options import ReadOptions


def xyz(rng, n=12):
    return rng.normal(size=(3, n)).astype(np.float32) * 5.0


def columns_of(x, y, z, kind=FLOAT):
    return [("x", kind, x), ("y", kind, y), ("z", kind, z)]


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def test_fields_in_any_order_with_gaps(bag, messages, rng):
    x, y, z = xyz(rng)
    x[3] = np.nan
    columns = columns_of(x, y, z)
    layouts = [
        {"columns": columns},
        {"columns": [("ring", UINT16, np.ones(12)), columns[2], *columns[:2]]},
        {"columns": columns_of(x, y, z, DOUBLE), "step": 48},
        {"columns": columns, "height": 3, "padding": 7},
        {"columns": columns, "big": True},
    ]
    content = [
        ("/points", START + k, cloud_message(messages, START + k, **layout))
        for k, layout in enumerate(layouts)
    ]
    recording = read(bag(content))
    assert recording.dimension == 3
    assert recording.n_scans == len(layouts)
    assert recording.beam_time is None
    expected = np.stack([x, y, z], axis=1)
    expected[3] = np.nan
    for scan in range(len(layouts)):
        np.testing.assert_array_equal(recording.points[recording.beams_of(scan)], expected)
        assert recording.hit[recording.beams_of(scan)].sum() == 11


def test_point_times(bag, messages, rng):
    x, y, z = xyz(rng)
    after = np.linspace(0.0, 0.1, 12)
    times = [
        ("t", UINT32, np.round(after * 1e9)),
        ("time", FLOAT, after),
        ("timestamp", DOUBLE, START / 1e9 + after),
        ("timestamp", DOUBLE, START + np.round(after * 1e9)),
        ("offset_time", UINT32, np.round(after * 1e6)),
    ]
    for name, kind, values in times:
        columns = [*columns_of(x, y, z), (name, kind, values)]
        content = [("/points", START, cloud_message(messages, START, columns))]
        recording = read(bag(content, f"{name}{kind}{values[-1]:.0f}"))
        np.testing.assert_allclose(recording.beam_time, after, atol=2e-6)


def test_damaged_clouds_are_counted(bag, messages, rng):
    columns = columns_of(*xyz(rng))
    odd = [
        {},
        {"width": 2**32 - 1},
        {"point_step": 0},
        {"row_step": 3},
        {"width": 13, "row_step": 0},
        {"point_step": 2**32 - 1},
        {"fields": []},
    ]
    content = [
        ("/points", START + k, cloud_message(messages, START + k, columns, **changes))
        for k, changes in enumerate(odd)
    ]
    recording = read(bag(content))
    assert recording.n_scans == 1
    found = {reason: one.count for reason, one in recording.source.skipped.items()}
    assert found == {cloud_module.WRONG_SIZE: 5, cloud_module.NO_COORDINATES: 1}


def test_extrinsics_and_odometry(bag, messages, rng):
    columns = columns_of(*xyz(rng))
    mounts = [
        messages.transform(0, "base_link", "front", (1, 0, 0.5)),
        messages.transform(0, "base_link", "rear", (-1, 0, 0.5), (0, 0, 1, 0)),
    ]
    content = [("/tf_static", START, messages.tf(*mounts))]
    for k in range(4):
        stamp = START + k * SECOND
        move = messages.transform(stamp, "odom", "base_link", (k, 0, 0.1 * k))
        content.append(("/tf", stamp, messages.tf(move)))
        for frame in ("front", "rear"):
            cloud = cloud_message(messages, stamp, columns, frame=frame)
            content.append((f"/{frame}/points", stamp, cloud))
    recording = read(bag(content))
    assert recording.n_scans == 8
    places = recording.T_base_sensor[recording.sensor]
    assert sorted(places[:2, 0, 3]) == [-1.0, 1.0]
    np.testing.assert_allclose(recording.T_odom_base[::2, 2, 3], 0.1 * np.arange(4), atol=1e-9)


def test_named_topics_are_used_together_or_refused(bag, messages, rng):
    columns = columns_of(*xyz(rng))
    mount = messages.transform(0, "base_link", "front", (1, 0, 0.5))
    rear = messages.transform(0, "base_link", "rear", (-1, 0, 0.5))
    topics = {"/front": "front", "/rear": "rear", "/copy": "front", "/lost": "nowhere"}
    content = [("/tf_static", START, messages.tf(mount, rear))]
    for k in range(3):
        stamp = START + k * SECOND
        for topic, frame in topics.items():
            cloud = cloud_message(messages, stamp, columns, frame=frame)
            content.append((topic, stamp, cloud))
    path = bag(content)
    both = read(path, ReadOptions(topic="/front,rear"))
    assert both.n_scans == 6
    assert sorted(both.T_base_sensor[np.unique(both.sensor), 0, 3]) == [-1.0, 1.0]
    assert read(path, ReadOptions(topic="/lost")).n_scans == 3
    for topic, why in (("/lost", "no transform connects 'nowhere'"), ("/front", "same sensor")):
        named = f"/copy,{topic}" if topic == "/front" else f"/front,{topic}"
        with pytest.raises(InputError, match=f"topic '{topic}' cannot be used with .*{why}"):
            read(path, ReadOptions(topic=named))
    assert read(path).n_scans == 6  # what nobody named is left out with a note


def image_message(messages, stamp, pixels, encoding, row_bytes=None, **changes):
    height, width = pixels.shape[:2]
    row = pixels.reshape(height, -1).view(np.uint8)
    step = row_bytes or row.shape[1]
    data = np.zeros((height, step), np.uint8)
    data[:, : row.shape[1]] = row
    kind = "sensor_msgs/msg/Image"
    stated = {"height": height, "width": width, "encoding": encoding, "is_bigendian": 0}
    stated = stated | {"step": step, "data": data.ravel()} | changes
    return kind, messages.make(kind, messages.header(stamp, "camera"), **stated)


def bag_with_images(messages, rng, image_messages):
    columns = columns_of(*xyz(rng))
    mounts = [messages.transform(0, "lidar", "camera", (0.1, 0.2, 0.3), (-0.5, 0.5, -0.5, 0.5))]
    content = [("/tf_static", START, messages.tf(*mounts))]
    for k in range(3):
        stamp = START + k * SECOND
        content.append(("/points", stamp, cloud_message(messages, stamp, columns)))
    return content + image_messages


def test_images_are_decoded_on_demand(bag, messages, rng):
    colours = rng.integers(0, 256, (6, 4, 3), np.uint8)
    grey = rng.integers(0, 256, (6, 4), np.uint8)
    depth = rng.integers(0, 5000, (6, 4), np.uint16)
    stream = io.BytesIO()
    Image.fromarray(colours).save(stream, "PNG")
    kind, data = "sensor_msgs/msg/CompressedImage", np.frombuffer(stream.getvalue(), np.uint8)
    packed = messages.make(kind, messages.header(START + 4, "camera"), "png", data)
    shown = {
        1: ("/cam/image", colours, "rgb8"),
        2: ("/cam/image", colours[..., ::-1].copy(), "bgr8", 20),
        3: ("/grey/image", grey, "mono8"),
        5: ("/depth/image", depth, "16UC1"),
    }
    image_messages = [
        (topic, START + k, image_message(messages, START + k, *what))
        for k, (topic, *what) in shown.items()
    ]
    image_messages.append(("/other/image/compressed", START + 4, (kind, packed)))
    images = read(bag(bag_with_images(messages, rng, image_messages))).images
    assert images is not None
    np.testing.assert_array_equal(images.stamp_ns, START + np.arange(1, 6))
    for number, expected in enumerate((colours, colours, grey, colours, depth)):
        np.testing.assert_array_equal(images.read(number), expected)
    assert images.cameras[images.camera[2]].name == "/grey/image"
    T = images.cameras[0].T_base_camera
    np.testing.assert_allclose(T[:3, 2], [1, 0, 0], atol=1e-12)  # looks ahead
    np.testing.assert_allclose(T[:3, 3], [0.1, 0.2, 0.3])


def test_bayer(bag, messages, rng):
    mosaic = np.array([[10, 20], [40, 30]], np.uint8)  # red, green, green, blue
    image_messages = [
        ("/cam/image", START + 1, image_message(messages, START + 1, mosaic, "bayer_rggb8"))
    ]
    images = read(bag(bag_with_images(messages, rng, image_messages))).images
    np.testing.assert_array_equal(images.read(0), np.full((2, 2, 3), [10, 30, 30]))


@pytest.mark.parametrize("name", ["image_raw", "image_rect", "image_rect_color"])
def test_camera_calibration(bag, messages, rng, name):
    """Rectified images use the projection matrix, and the rectified camera is rotated."""
    kind, turn = "sensor_msgs/msg/CameraInfo", Rotation.from_rotvec([0.0, 0.1, 0.0]).as_matrix()
    K = np.array([9.0, 0, 2, 0, 9, 3, 0, 0, 1])
    P = np.array([8.0, 0, 2.5, -0.8, 0, 8, 3.5, 0, 0, 0, 1, 0])
    values = ["plumb_bob", np.arange(5.0), K, turn.ravel(), P]
    info = messages.make(kind, messages.header(START, "camera"), 6, 4, *values)
    image = image_message(messages, START + 1, np.zeros((6, 4), np.uint8), "mono8")
    images = [("/cam/camera_info", START, (kind, info)), (f"/cam/{name}", START + 1, image)]
    camera = read(bag(bag_with_images(messages, rng, images))).images.cameras[0]
    ahead = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    if name == "image_raw":
        np.testing.assert_array_equal(camera.K.ravel(), K)
        np.testing.assert_array_equal(camera.distortion, np.arange(5.0))
        assert camera.model == "plumb_bob"
        turn = np.eye(3)
    else:
        np.testing.assert_array_equal(camera.K, [[8, 0, 2.5], [0, 8, 3.5], [0, 0, 1]])
        assert (camera.model, len(camera.distortion)) == ("", 0)
    np.testing.assert_allclose(camera.T_base_camera[:3, :3], ahead @ turn.T, atol=1e-12)
    np.testing.assert_allclose(camera.T_base_camera[:3, 3], [0.1, 0.2, 0.3])
