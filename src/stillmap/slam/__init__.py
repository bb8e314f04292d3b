"""The M-step: poses, loops and map given P(static) of every beam, which is only read."""

from stillmap.slam.deskew import deskew_recording as deskew_recording
from stillmap.slam.m_step import m_step as m_step
from stillmap.slam.options import SlamOptions as SlamOptions
from stillmap.slam.pose_graph import PoseGraph as PoseGraph
from stillmap.slam.scan_hits import FREE_SPACE_MARGIN as FREE_SPACE_MARGIN
from stillmap.slam.types import BareStretch as BareStretch
from stillmap.slam.types import Diagnostics as Diagnostics
from stillmap.slam.types import LoopClosure as LoopClosure
from stillmap.slam.types import MStepResult as MStepResult
