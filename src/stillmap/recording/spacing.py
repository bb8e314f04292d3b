"""How far apart the beams of a 3D sensor end: what is finer nobody saw."""

from stillmap.recording.model import Recording

_USUAL = 0.15  # m


def spacing(recording: Recording) -> float:
    """Edge in metres of the cells of a 3D recording."""
    if recording.dimension != 3:
        raise ValueError("recording: expected 3 dimensions")
    return _USUAL
