"""Rendering of 3-D Gaussians: colour, depth and opacity of a view, in plain numpy and in numba."""

from bathyscope.splat.render import PreparedScene, prepare, project, render
from bathyscope.splat.rendering import Projection, Rendering
from bathyscope.splat.settings import Backend, Precision, SplatSettings

__all__ = [
    "Backend",
    "Precision",
    "PreparedScene",
    "Projection",
    "Rendering",
    "SplatSettings",
    "prepare",
    "project",
    "render",
]
