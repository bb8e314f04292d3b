"""The M-step: poses and the map that they make. Uses e as weights, never changes it."""

from stillmap.slam.deskew import deskew_recording
from stillmap.slam.loop_types import LoopClosure
from stillmap.slam.m_step import StepProgress, m_step
from stillmap.slam.odometry_2d import Diagnostics, MStepResult, SlamOptions
from stillmap.slam.pose_graph import PoseGraph

__all__ = [
    "Diagnostics",
    "LoopClosure",
    "MStepResult",
    "PoseGraph",
    "SlamOptions",
    "StepProgress",
    "deskew_recording",
    "m_step",
]
