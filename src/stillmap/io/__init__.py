"""Readers and writers of recordings, one module per format."""

from stillmap.core.recording import Recording
from stillmap.io.reader import read
from stillmap.io.stillmap_folder import write
from stillmap.prepare.options import ReadOptions

__all__ = ["ReadOptions", "Recording", "read", "write"]
