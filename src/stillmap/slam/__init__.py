"""The M-step: poses, loops and map given P(static) of every beam, which is only read."""

from stillmap.slam.deskew import deskew_recording
from stillmap.slam.m_step import m_step
from stillmap.slam.options import SlamOptions
from stillmap.slam.pose_graph import PoseGraph
from stillmap.slam.scan_hits import FREE_SPACE_MARGIN
from stillmap.slam.types import BareStretch, Diagnostics, LoopClosure, MStepResult

__all__ = [
    "FREE_SPACE_MARGIN",
    "BareStretch",
    "Diagnostics",
    "LoopClosure",
    "MStepResult",
    "PoseGraph",
    "SlamOptions",
    "deskew_recording",
    "m_step",
]
