"""Readers and writers of recordings, one module per format."""

from stillmap.core.recording import Recording
from stillmap.io.from_arrays import recording_from_clouds, recording_from_scans
from stillmap.io.reader import read
from stillmap.io.stillmap_folder import write
from stillmap.prepare.options import ReadOptions

Recording.from_scans = staticmethod(recording_from_scans)
Recording.from_clouds = staticmethod(recording_from_clouds)

__all__ = ["ReadOptions", "Recording", "read", "write"]
