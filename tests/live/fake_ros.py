"""Modules of the node without ROS: messages take any field, tf2_ros is that of tests/ros."""

import importlib
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "ros"))
import tf2_ros

Fields = tf2_ros.Fields


class Marker(Fields):
    ARROW, CYLINDER, DELETEALL = 0, 3, 3


class PointField(Fields):
    FLOAT32 = 7


class QoS(Fields):
    TRANSIENT_LOCAL = 1


class Module(ModuleType):
    """A package of messages, or a part of rclpy."""

    def __init__(self, name, **content):
        super().__init__(name)
        self.__dict__.update(content)

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return Fields


MODULES = [
    Module("rclpy.time", Time=tf2_ros.Time),
    Module("rclpy.duration", Duration=tf2_ros.Duration),
    Module("rclpy.qos", DurabilityPolicy=QoS),
    Module("visualization_msgs.msg", Marker=Marker),
    Module("sensor_msgs.msg", PointField=PointField),
    *(Module(f"{package}_msgs.msg") for package in ("diagnostic", "geometry", "map", "nav", "std")),
    Module("builtin_interfaces.msg"),
]


def load(name):
    """A module of `stillmap.live.ros`; afterwards neither it nor ROS can be imported."""
    fakes = {module.__name__: module for module in MODULES}
    for module in MODULES:
        package, _, part = module.__name__.partition(".")
        fakes.setdefault(package, Module(package)).__dict__[part] = module
    sys.modules.update(fakes)
    try:
        return importlib.import_module(f"stillmap.live.ros.{name}")
    finally:
        for one in (*fakes, f"stillmap.live.ros.{name}"):
            sys.modules.pop(one, None)


class Node:
    """Keeps what is published, by topic."""

    def __init__(self):
        self.sent, self.listeners = {}, 1

    def create_publisher(self, _, topic, __):
        return SimpleNamespace(
            publish=self.sent.setdefault(topic, []).append,
            get_subscription_count=lambda: self.listeners,
        )

    def get_logger(self):
        return SimpleNamespace(warning=lambda _: None)


class Broadcaster:
    """Of transforms, which the node keeps."""

    def __init__(self, node):
        self.sendTransform = node.sent.setdefault("/tf", []).append
