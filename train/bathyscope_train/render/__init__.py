"""Rendering of predicted Gaussians, with gradients."""

from bathyscope_train.render.contract import Renderer, Rendering
from bathyscope_train.render.cpu import CpuRenderer
from bathyscope_train.render.gsplat import GsplatRenderer
from bathyscope_train.render.reference import ReferenceRenderer

__all__ = ["CpuRenderer", "GsplatRenderer", "ReferenceRenderer", "Renderer", "Rendering"]
