"""What every part of Bathyscope agrees on: geometry, clips, results, bundles, errors."""

from bathyscope.bundle import Bundle, BundleManifest, shipped_bundle
from bathyscope.clip import Clip
from bathyscope.errors import BathyscopeError
from bathyscope.gaussians import Gaussians
from bathyscope.result import ClipDepth, FrameDepth, ResultMeta
from bathyscope.result_files import load_npz, save_npz

__all__ = [
    "BathyscopeError",
    "Bundle",
    "BundleManifest",
    "Clip",
    "ClipDepth",
    "FrameDepth",
    "Gaussians",
    "ResultMeta",
    "load_npz",
    "save_npz",
    "shipped_bundle",
]
