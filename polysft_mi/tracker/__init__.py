"""The way of a video through the solver: window after window, frame after frame, with checkpoints.
In: a problem and a solver. Out: a :class:`Track`, the state of every frame. Windows, other starts,
coarse to fine, sweeps and smoothing are decided here. Import only after a Mitsuba variant is set.
"""

from .checkpoint import CHECKPOINT, Track
from .frame import FrameTracker
from .video import track

__all__ = ["CHECKPOINT", "FrameTracker", "Track", "track"]
