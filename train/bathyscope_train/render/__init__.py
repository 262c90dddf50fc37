"""Rendering of predicted Gaussians, with gradients."""

from bathyscope_train.render.contract import Renderer, Rendering
from bathyscope_train.render.cpu import CpuRenderer
from bathyscope_train.render.gsplat import GsplatRenderer
from bathyscope_train.render.reference import ReferenceRenderer
from bathyscope_train.render.views import inside_only, leave_one_out

__all__ = [
    "CpuRenderer",
    "GsplatRenderer",
    "ReferenceRenderer",
    "Renderer",
    "Rendering",
    "inside_only",
    "leave_one_out",
]
