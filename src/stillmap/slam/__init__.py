"""The M-step: poses and the map that they make. Uses e as weights, never changes it."""

from stillmap.slam.deskew import deskewed
from stillmap.slam.loop_types import Closure
from stillmap.slam.m_step import Told, m_step
from stillmap.slam.odometry_2d import Doubts, Mapped, SlamOptions
from stillmap.slam.pose_graph import Graph

__all__ = ["Closure", "Doubts", "Graph", "Mapped", "SlamOptions", "Told", "deskewed", "m_step"]
