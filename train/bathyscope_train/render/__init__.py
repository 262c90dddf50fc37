"""Rendering of predicted Gaussians, with gradients."""

from bathyscope_train.render.reference import ReferenceRenderer, Renderer, Rendering

__all__ = ["ReferenceRenderer", "Renderer", "Rendering"]
