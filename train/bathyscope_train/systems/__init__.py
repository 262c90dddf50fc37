"""Every system of the tables behind one interface: frames in; depth, confidence and what else it knows out."""

from bathyscope_train.systems.registry import Unavailable, open_system
from bathyscope_train.systems.system import FrameEstimate, System, SystemInfo, SystemOptions

__all__ = ["FrameEstimate", "System", "SystemInfo", "SystemOptions", "Unavailable", "open_system"]
