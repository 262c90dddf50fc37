"""The multi-view network: images of one clip in; cameras, depth and Gaussians out."""

from bathyscope_train.model.network import DenseMaps, Features, Network, Prediction
from bathyscope_train.model.presets import NetworkPreset, get_preset

__all__ = ["DenseMaps", "Features", "Network", "NetworkPreset", "Prediction", "get_preset"]
