"""Procedural endoscopy: rendered clips with exact depth, poses and intrinsics."""

from bathyscope_train.data.synthetic.clip import SyntheticClip, render_clip
from bathyscope_train.data.synthetic.domain import Domain
from bathyscope_train.data.synthetic.domains import DOMAINS

__all__ = ["DOMAINS", "Domain", "SyntheticClip", "render_clip"]
