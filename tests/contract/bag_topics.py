"""Messages of the bags that results become, read by the library of MCAP."""

from collections import defaultdict

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stillmap.cli.main import main


def convert(result, path, *more):
    assert main(["convert", str(result), "-o", str(path), "--quiet", *more]) == 0
    return path


def decode_mcap(result):
    """Summary and messages by topic, decoded by the schemas in the file alone."""
    reader_of = pytest.importorskip("mcap.reader").make_reader
    decoder = pytest.importorskip("mcap_ros2.decoder").DecoderFactory()
    topics = defaultdict(list)
    with convert(result, result.parent / f"{result.name}.mcap").open("rb") as file:
        reader = reader_of(file, validate_crcs=True, decoder_factories=[decoder])
        summary = reader.get_summary()
        for _, channel, message, ros in reader.iter_decoded_messages():
            topics[channel.topic].append((message.log_time, ros))
    return summary, topics


def nanoseconds(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def matrix(translation, q):
    """(4, 4) of a position and a quaternion."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = translation.x, translation.y, translation.z
    return T


def placed(transform):
    """(4, 4) of a Transform."""
    return matrix(transform.translation, transform.rotation)


def assert_grid(grid, result):
    """An OccupancyGrid holds the map of a result."""
    with np.load(result / "map.npz") as archive:
        p, origin, resolution = (archive[n] for n in ("p_occupied", "origin", "resolution"))
    cells = np.array(grid.data).reshape(grid.info.height, grid.info.width)
    np.testing.assert_array_equal(cells == -1, np.isnan(p))
    assert np.abs(cells - 100 * p)[cells >= 0].max() <= 0.501
    assert grid.info.resolution == np.float32(resolution)
    place = grid.info.origin.position
    np.testing.assert_allclose([place.x, place.y], origin[:2])
