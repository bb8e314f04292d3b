"""A client of the Foxglove WebSocket protocol, and a reader of its messages, for the tests."""

import base64
import json
import struct
import time

import numpy as np
import websockets.sync.client

_MESSAGE_DATA, _TIME = 1, 2
_NUMBERS = {1: "u1", 2: "i1", 7: "<f4", 8: "<f8"}  # of PackedElementField


def fields(data):
    """(number, value) of each field of a protobuf message: integers, floats as bytes, or bytes."""
    at = 0
    while at < len(data):
        key, at = varint(data, at)
        kind = key & 7
        if kind == 0:
            value, at = varint(data, at)
        else:
            size = {1: 8, 5: 4}.get(kind)
            if size is None:
                assert kind == 2
                size, at = varint(data, at)
            assert at + size <= len(data)
            value, at = data[at : at + size], at + size
        yield key >> 3, value


def varint(data, at):
    value, shift = 0, 0
    while True:
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at


class Schemas:
    """Message types of a FileDescriptorSet: names, types and numbers of their fields."""

    def __init__(self, descriptor):
        self.types = {}
        for _, file in fields(descriptor):
            parts = list(fields(file))
            package = next(value.decode() for number, value in parts if number == 2)
            for number, message in parts:
                if number == 4:
                    self._add(package, message)

    def _add(self, package, message):
        parts = list(fields(message))
        name = f"{package}.{next(value.decode() for number, value in parts if number == 1)}"
        self.types[f".{name}"] = {}
        for number, part in parts:
            if number == 2:  # a field: name, number, label, type, type name
                about = dict(fields(part))
                entry = about[1].decode(), about[4], about[5], about.get(6, b"").decode()
                self.types[f".{name}"][about[3]] = entry
            elif number == 3:  # a type within
                self._add(name, part)

    def read(self, name, data):
        """A dict of a message: repeated fields are lists, those left out are missing."""
        out = {}
        for number, value in fields(data):
            field, label, kind, type_name = self.types[name][number]
            if kind == 11:
                value = self.read(type_name, value)
            elif kind == 9:
                value = value.decode()
            elif kind == 1:
                value = struct.unpack("<d", value)[0]
            elif kind == 7:
                value = struct.unpack("<I", value)[0]
            if label == 3:
                out.setdefault(field, []).append(value)
            else:
                out[field] = value
        return out


class Client:
    """Subscribes to topics and keeps what arrives.

    Attributes:
        topics: schema by topic that is advertised.
        subscribed: topics that were subscribed to.
        received: by topic, the messages as dicts, in their order.
        times: what the server said that time it is.
    """

    def __init__(self, url, **options):
        self._connection = websockets.sync.client.connect(
            url, subprotocols=["foxglove.sdk.v1"], max_size=None, **options
        )
        self._socket = self._connection.__enter__()
        self.topics, self._channels, self._wanted, self.subscribed = {}, {}, set(), set()
        self.received, self.times, self.info = {}, [], json.loads(self._socket.recv(10))

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._connection.__exit__(*error)

    def subscribe(self, *topics):
        """To be sent these, as soon as they are advertised."""
        self._wanted |= set(topics)
        self._subscribe()

    def wait(self, done, seconds=20.0):
        """Receive until `done(self)`."""
        deadline = time.monotonic() + seconds
        while not done(self):
            left = deadline - time.monotonic()
            assert left > 0, f"{sorted(self.topics)}; received {sorted(self.received)}"
            self._receive(left)

    def read_all(self):
        """Receive until the server ends the connection."""
        try:
            while True:
                self._receive(60.0)
        except websockets.exceptions.ConnectionClosed:
            pass

    def _receive(self, timeout):
        try:
            message = self._socket.recv(timeout)
        except TimeoutError:
            return
        if isinstance(message, str):
            self._take_text(json.loads(message))
        elif message[0] == _TIME:
            self.times.append(struct.unpack("<Q", message[1:9])[0])
        else:
            assert message[0] == _MESSAGE_DATA
            subscription, stamp = struct.unpack("<IQ", message[1:13])
            topic, name, schemas = self._channels[subscription]
            found = schemas.read(f".{name}", message[13:])
            self.received.setdefault(topic, []).append({"log_time": stamp, **found})

    def _take_text(self, message):
        if message["op"] != "advertise":
            return
        for channel in message["channels"]:
            assert channel["encoding"] == channel["schemaEncoding"] == "protobuf"
            name, topic = channel["schemaName"], channel["topic"]
            schemas = Schemas(base64.b64decode(channel["schema"]))
            self._channels[channel["id"]] = topic, name, schemas
            self.topics[topic] = name
        self._subscribe()

    def _subscribe(self):
        ids = [k for k, (topic, *_) in self._channels.items() if topic in self._wanted]
        if ids:
            self.subscribed |= {self._channels[k][0] for k in ids}
            self._wanted -= self.subscribed
            subscriptions = [{"id": k, "channelId": k} for k in ids]
            self._socket.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))


def stamp_of(message):
    """Nanoseconds of the message's own stamp."""
    stamp = message["timestamp"]
    return 10**9 * stamp.get("seconds", 0) + stamp.get("nanos", 0)


def to_matrix(position, rotation):
    """(4, 4) of a vector and a quaternion as messages."""
    x, y, z, w = (rotation.get(name, 0.0) for name in "xyzw")
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = [position.get(name, 0.0) for name in "xyz"]
    return T


def pose_of(pose):
    """(4, 4) of a Pose."""
    return to_matrix(pose["position"], pose["orientation"])


def rows_of(message, stride):
    """Arrays by name of packed elements."""
    data = np.frombuffer(message.get("data", b""), np.uint8).reshape(-1, stride)
    out = {}
    for field in message["fields"]:
        kind, first = np.dtype(_NUMBERS[field["type"]]), field.get("offset", 0)
        part = np.ascontiguousarray(data[:, first : first + kind.itemsize])
        out[field["name"]] = part.view(kind)[:, 0]
    return out


def points_of(cloud):
    """(n, 3) points in the map, and P(static), of a PointCloud."""
    rows = rows_of(cloud, cloud["point_stride"])
    points = np.stack([rows[axis] for axis in "xyz"], axis=1)
    T = pose_of(cloud["pose"])
    return points @ T[:3, :3].T + T[:3, 3], rows["p_static"]


def grid_of(grid):
    """(x, y) of the corner, edge of a cell, and (H, W) per cent, 255 unknown, of a Grid."""
    percent = rows_of(grid, grid["cell_stride"])["occupancy"].reshape(-1, grid["column_count"])
    assert grid["row_stride"] == grid["cell_stride"] * grid["column_count"]
    return pose_of(grid["pose"])[:2, 3], grid["cell_size"]["x"], percent
