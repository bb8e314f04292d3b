"""Tracking of moving objects: clusters of dynamic end points, associated over time."""

from stillmap.tracking.flow_map import FlowMap, compute_flow_map
from stillmap.tracking.objects import MovingObject, ObjectOptions, track_objects

__all__ = ["FlowMap", "MovingObject", "ObjectOptions", "compute_flow_map", "track_objects"]
