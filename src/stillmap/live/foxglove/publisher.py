"""The WebSocket server: what is new goes to its topics, to those who subscribed to them."""

import time
from collections.abc import Callable

import numpy as np
from foxglove import Context, start_server
from foxglove.channels import (
    FrameTransformsChannel,
    GridChannel,
    LogChannel,
    PointCloudChannel,
    PoseInFrameChannel,
    SceneUpdateChannel,
)
from foxglove.websocket import Capability, ChannelView, Client, ServerListener

from stillmap.core.errors import InputError
from stillmap.live.foxglove import schemas
from stillmap.live.foxglove.answer import Answer
from stillmap.live.foxglove.mailbox import Mail, keep_last
from stillmap.live.foxglove.tile_map import TileMap

_PERIOD = 1.0  # s at least between two maps, and between two paths
# messages that wait for a client that does not read; the oldest are dropped
_BACKLOG = 128


class Publisher:
    """A server and its topics.

    Args:
        host: address to listen at.
        port: 0: any free one.
        on_subscribe: called in another thread when a client subscribes, or no longer does.

    Raises:
        InputError: the port is taken, or the host is none of this machine.
    """

    def __init__(self, host: str, port: int, on_subscribe: Callable[[], None]) -> None:
        context = Context()
        self._context, self._listener = context, _Listener(on_subscribe)
        self._map = GridChannel("/map", context=context)
        self._map_points = PointCloudChannel("/map_points", context=context)
        self._pose = PoseInFrameChannel("/pose", context=context)
        self._path = SceneUpdateChannel("/path", context=context)
        self._movers = SceneUpdateChannel("/movers", context=context)
        self._tf = FrameTransformsChannel("/tf", context=context)
        self._doubts = LogChannel("/doubts", context=context)
        self._clouds = dict[str | int, tuple[PointCloudChannel, PointCloudChannel]]()
        self._map_due, self._path_due = 0.0, 0.0
        self._begin()
        try:
            self._server = start_server(
                name="stillmap",
                host=host,
                port=port,
                context=context,
                capabilities=[Capability.Time],  # nobody may publish, call or set anything
                server_listener=self._listener,
                message_backlog_size=_BACKLOG,
            )
        except RuntimeError as error:
            raise InputError(f"cannot serve at {host}:{port}: {_reason(error)}") from error

    def _begin(self) -> None:
        """Nothing has been published of a map."""
        self._tiles, self._positions = TileMap(), np.zeros((0, 2))
        self._answers = dict[str | int, Answer]()
        self._is_map_new, self._is_path_new = False, False
        self._last_doubts: tuple[str, ...] | None = None
        self._stamp_ns = 0

    @property
    def port(self) -> int:
        """At which it listens."""
        return self._server.port

    @property
    def is_watched(self) -> bool:
        """True if a client has subscribed to anything."""
        return bool(self._listener.subscriptions)

    @property
    def due(self) -> float | None:
        """Seconds until a map or path that is new may be sent; None: there is none."""
        pairs = ((self._is_map_new, self._map_due), (self._is_path_new, self._path_due))
        times = [due for is_new, due in pairs if is_new]
        return max(min(times) - time.monotonic(), 0.0) if times else None

    def stop(self) -> None:
        """End the server and its connections."""
        self._server.stop()

    def publish(self, mail: Mail) -> None:
        """Send what is new; to clients that have just come, what they missed."""
        if mail.begins_anew:
            self._begin()
        if mail.changes:
            self._tiles.add(keep_last(mail.changes), mail.resolution)
            self._is_map_new = True
        if mail.path is not None:
            self._positions, self._is_path_new = mail.path, True
        answers = list(mail.answers.values())
        self._answers.update(mail.answers)
        if self._listener.take_news():
            self._is_map_new, self._is_path_new, self._last_doubts = True, True, None
            answers = list(self._answers.values())
        for answer in sorted(answers, key=lambda answer: answer.stamp_ns):
            self._publish_answer(answer)
        self._publish_slow()

    def _publish_answer(self, answer: Answer) -> None:
        stamp = max(answer.stamp_ns, 0)
        if stamp >= self._stamp_ns:
            self._stamp_ns = stamp
            self._server.broadcast_time(stamp)
            self._tf.log(schemas.to_transforms(answer), log_time=stamp)
            self._pose.log(schemas.to_pose_in_frame(answer), log_time=stamp)
            self._movers.log(schemas.to_movers(answer), log_time=stamp)
            if answer.doubts != self._last_doubts:
                self._last_doubts = answer.doubts
                self._doubts.log(schemas.to_log(answer.doubts, stamp), log_time=stamp)
        channels = self._clouds_of(answer.sensor)
        if any(channel.has_sinks() for channel in channels):
            for channel, cloud in zip(channels, schemas.to_clouds(answer), strict=True):
                channel.log(cloud, log_time=stamp)

    def _publish_slow(self) -> None:
        """Map and path, which take long, at most once a second."""
        now, stamp = time.monotonic(), self._stamp_ns
        if self._is_map_new and now >= self._map_due and self._tiles.dimension:
            self._is_map_new, self._map_due = False, now + _PERIOD
            if self._tiles.dimension == 2 and self._map.has_sinks():
                self._map.log(schemas.to_grid(self._tiles.to_cells(), stamp), log_time=stamp)
            elif self._tiles.dimension == 3 and self._map_points.has_sinks():
                cloud = schemas.to_map_cloud(self._tiles.to_points(), stamp)
                self._map_points.log(cloud, log_time=stamp)
        if self._is_path_new and now >= self._path_due and len(self._positions):
            self._is_path_new, self._path_due = False, now + _PERIOD
            if self._path.has_sinks():
                self._path.log(schemas.to_path(self._positions, stamp), log_time=stamp)

    def _clouds_of(self, sensor: str | int) -> tuple[PointCloudChannel, PointCloudChannel]:
        """Topics of a sensor, as the node in ROS 2 names them; without a name `scan`."""
        if sensor not in self._clouds:
            name = str(sensor).strip("/") if sensor else "scan"
            name = f"scan_{sensor}" if sensor and isinstance(sensor, int) else name
            static, dynamic = (
                PointCloudChannel(f"/{name}_{label}", context=self._context)
                for label in ("static", "dynamic")
            )
            self._clouds[sensor] = static, dynamic
        return self._clouds[sensor]


class _Listener(ServerListener):
    """Notes that a client has come."""

    def __init__(self, notify: Callable[[], None]) -> None:
        self._notify, self._has_news = notify, False
        self.subscriptions = set[tuple[int, int]]()  # client and channel

    def take_news(self) -> bool:
        """True if a client has subscribed since the last call."""
        if not self._has_news:  # set in another thread: what comes after this is news again
            return False
        self._has_news = False
        return True

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        self.subscriptions.add((client.id, channel.id))
        self._has_news = True
        self._notify()

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        self.subscriptions.discard((client.id, channel.id))
        self._notify()


def _reason(error: RuntimeError) -> str:
    """The cause alone, as `Address already in use`."""
    text = str(error).rpartition(": ")[2].partition(" (os error")[0]
    return text[:1].lower() + text[1:]
