"""Recordings: one shape for all formats, one file per format."""

from stillmap.recording.folder import write
from stillmap.recording.formats import read
from stillmap.recording.model import Recording
from stillmap.recording.options import ReadOptions

__all__ = ["ReadOptions", "Recording", "read", "write"]
