"""Training on videos without ground truth: what is rendered has to agree with the video, the world and itself."""

from bathyscope_train.consistency.settings import ConsistencySettings, load_consistency_settings

__all__ = ["ConsistencySettings", "load_consistency_settings"]
