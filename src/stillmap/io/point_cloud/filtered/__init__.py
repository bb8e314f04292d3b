"""Filtered copies of point clouds: points removed, all other bytes unchanged."""
