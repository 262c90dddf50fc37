"""EndoDAV: Video Depth Anything adapted to endoscopy by self-supervision, in the option sets of its public code."""

from bathyscope_train.systems.endodav.network import EndoDav
from bathyscope_train.systems.endodav.settings import EndoDavSettings

__all__ = ["EndoDav", "EndoDavSettings"]
