"""Procedural endoscopy: rendered clips with exact depth, poses and intrinsics."""

from bathyscope_train.data.synthetic.clip import SyntheticClip, render_clip
from bathyscope_train.data.synthetic.domain import Domain
from bathyscope_train.data.synthetic.domains import DOMAINS
from bathyscope_train.data.synthetic.flow import Flow, optical_flow
from bathyscope_train.data.synthetic.folder import write_dataset_folder
from bathyscope_train.data.synthetic.shards import clip_paths, read_clip, write_clips

__all__ = [
    "DOMAINS",
    "Domain",
    "Flow",
    "SyntheticClip",
    "clip_paths",
    "optical_flow",
    "read_clip",
    "render_clip",
    "write_clips",
    "write_dataset_folder",
]
