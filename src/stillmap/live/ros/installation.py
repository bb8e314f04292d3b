"""The user's own ROS 2: rclpy and message packages, imported when a node is made."""

from importlib import import_module
from types import ModuleType
from typing import Any

from stillmap.core.errors import InputError

# message packages without which there is no node; others are used where they are
_REQUIRED = ("sensor_msgs", "nav_msgs", "geometry_msgs")
_HINT = (
    "call `source /opt/ros/DISTRO/setup.bash` first, with the Python that this ROS was built for, "
    "or install stillmap into an environment that has rclpy"
)


class Ros:
    """rclpy and the message packages that are there.

    Attributes:
        rclpy: the module.

    Raises:
        InputError: rclpy, or a message package that is needed, cannot be imported.
    """

    def __init__(self) -> None:
        self.rclpy: Any = _import("rclpy")
        for package in _REQUIRED:
            _import(package)

    def message(self, name: str) -> Any:
        """A class by its name, as `sensor_msgs/msg/LaserScan`; None: its package is missing."""
        package, kind, type_name = name.split("/")
        try:
            return getattr(import_module(f"{package}.{kind}"), type_name)
        except ImportError:
            return None

    def create_publisher(self, node: Any, kind: str, topic: str, qos: Any) -> Any:
        """A publisher of a node; None: the package of its messages is missing."""
        message = self.message(kind)
        return None if message is None else node.create_publisher(message, topic, qos)

    def module(self, name: str) -> Any:
        """A module of rclpy, as `qos`."""
        return import_module(f"rclpy.{name}")


def _import(name: str) -> ModuleType:
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise InputError(f"{name} cannot be imported: {error}", hint=_HINT) from error
        raise InputError(f"{name} of ROS 2 is not in this environment", hint=_HINT) from error
    except ImportError as error:  # made for another Python
        raise InputError(f"{name} cannot be imported: {error}", hint=_HINT) from error
