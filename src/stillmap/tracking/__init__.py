"""What moved: end points of moving things, put together to things and followed over time."""

from stillmap.tracking.flow_map import Traffic, traffic
from stillmap.tracking.objects import MovingObject, moving_objects
from stillmap.tracking.options import ObjectOptions

__all__ = ["MovingObject", "ObjectOptions", "Traffic", "moving_objects", "traffic"]
