"""EndoDAC: self-supervised monocular depth of single images, with pose, intrinsics and flow networks."""

from bathyscope_train.systems.endodac.network import DepthNetwork
from bathyscope_train.systems.endodac.settings import DEPTH_SETTINGS, DepthSettings

__all__ = ["DEPTH_SETTINGS", "DepthNetwork", "DepthSettings"]
