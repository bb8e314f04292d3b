"""What moved: end points of moving things, put together to things and followed over time."""

from stillmap.objects.found import MovingObject, moving_objects
from stillmap.objects.options import ObjectOptions
from stillmap.objects.traffic import Traffic, traffic

__all__ = ["MovingObject", "ObjectOptions", "Traffic", "moving_objects", "traffic"]
