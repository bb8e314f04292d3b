"""What moved: end points of moving things, put together to things and followed over time."""

from stillmap.tracking.flow_map import FlowMap, compute_flow_map
from stillmap.tracking.objects import MovingObject, track_objects
from stillmap.tracking.options import ObjectOptions

__all__ = ["MovingObject", "ObjectOptions", "FlowMap", "track_objects", "compute_flow_map"]
