"""Between the source's pixels and the network's: crop to the field of view, resize, and the way back.

All maps use pixel centres at +0.5, so a resize is a scaling of coordinates and intrinsics carry over exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, Size, crop_intrinsics, scale_intrinsics
from bathyscope.model_spec import InputSpec
from bathyscope.vision.field_of_view import FieldOfView, Mask

F32 = NDArray[np.float32]
_LONGEST_ASPECT = 3.0
"""Longer pictures are squeezed: the network has seen nothing like them."""


@dataclass(frozen=True, slots=True)
class Grid:
    """How a crop of the source becomes an image of the network.

    Attributes:
        field_of_view: What is inside, at source size.
        size: (height, width) that the network sees.
        inside: (h, w) at the network's size: pixels wholly inside the field of view.
    """

    field_of_view: FieldOfView
    size: Size
    inside: Mask

    @classmethod
    def fit(cls, field_of_view: FieldOfView, wanted: InputSpec) -> Grid:
        """The grid for a field of view: its shape, the network's area, whole patches."""
        top, left, bottom, right = field_of_view.box
        return cls.of(field_of_view, choose_size((bottom - top, right - left), wanted.patch, wanted.pixels))

    @classmethod
    def of(cls, field_of_view: FieldOfView, size: Size) -> Grid:
        """The grid of a given size, whatever the proportions of the field of view."""
        top, left, bottom, right = field_of_view.box
        share = _shrink(field_of_view.mask[top:bottom, left:right].astype(np.float32), size)
        inside = share > 0.999
        return cls(field_of_view, size, inside if inside.any() else share > 0)

    @property
    def source_size(self) -> Size:
        """(height, width) of the source."""
        h, w = self.field_of_view.mask.shape
        return h, w

    @property
    def crop_size(self) -> Size:
        """(height, width) of the crop, in source pixels."""
        top, left, bottom, right = self.field_of_view.box
        return bottom - top, right - left

    def to_model(self, image: NDArray[np.uint8]) -> F32:
        """RGB (3, h, w) in [0, 1] of a source image (H, W, 3); 0 outside the field of view."""
        top, left, bottom, right = self.field_of_view.box
        mask = self.field_of_view.mask[top:bottom, left:right]
        picture = np.where(mask[..., None], image[top:bottom, left:right], np.uint8(0))
        small = _shrink(picture.astype(np.float32) / 255.0, self.size)
        return np.ascontiguousarray(np.clip(small, 0, 1).transpose(2, 0, 1), np.float32)

    def intrinsics_to_source(self, intrinsics: F64) -> F64:
        """Pixel intrinsics (..., 3, 3) of the network's image for the whole source image."""
        top, left, _, _ = self.field_of_view.box
        return crop_intrinsics(scale_intrinsics(intrinsics, self.size, self.crop_size), -left, -top)

    def intrinsics_to_model(self, intrinsics: F64) -> F64:
        """Pixel intrinsics (..., 3, 3) of the source for the network's image."""
        top, left, _, _ = self.field_of_view.box
        return scale_intrinsics(crop_intrinsics(intrinsics, left, top), self.crop_size, self.size)

    def to_source(self, values: F32, known: Mask) -> tuple[F32, Mask]:
        """A map (h, w) at source size, from its known pixels alone: nothing bleeds over their border.

        Args:
            values: At the network's size.
            known: Where they mean something.

        Returns:
            The map, 0 outside the field of view and where no known pixel is near; and where it is known.
        """
        top, left, bottom, right = self.field_of_view.box
        h, w = self.crop_size
        weight = known.astype(np.float32)
        total = _enlarge(np.where(known, values, 0).astype(np.float32), (h, w))
        share = _enlarge(weight, (h, w))
        mask = self.field_of_view.mask[top:bottom, left:right]
        total, share = _spread(total, share, mask, self._reach())
        found = mask & (share > 1e-3)
        full, where = np.zeros(self.source_size, np.float32), np.zeros(self.source_size, np.bool_)
        full[top:bottom, left:right][found] = (total[found] / share[found]).astype(np.float32)
        where[top:bottom, left:right] = found
        return full, where

    def _reach(self) -> int:
        """Source pixels that one pixel of the network covers, rounded up."""
        return int(np.ceil(max(self.crop_size[0] / self.size[0], self.crop_size[1] / self.size[1])))


def choose_size(crop: Size, patch: int, pixels: int) -> Size:
    """Height and width in whole patches, of about ``pixels`` pixels and the crop's proportions."""
    h, w = crop
    aspect = min(max(w / h, 1 / _LONGEST_ASPECT), _LONGEST_ASPECT)
    ideal = np.sqrt(pixels / aspect) / patch, np.sqrt(pixels * aspect) / patch
    candidates = [
        (rows, columns)
        for rows in range(max(3, int(ideal[0]) - 1), int(ideal[0]) + 3)
        for columns in range(max(3, int(ideal[1]) - 1), int(ideal[1]) + 3)
    ]

    def cost(size: tuple[int, int]) -> float:
        rows, columns = size
        stretch = abs(np.log(columns / rows / aspect))
        return float(2 * stretch + abs(np.log(rows * columns * patch * patch / pixels)))

    rows, columns = min(candidates, key=cost)
    return rows * patch, columns * patch


def _shrink(image: NDArray[np.float32], size: Size) -> NDArray[np.float32]:
    """Resize by area where the image gets smaller, linearly where it grows."""
    smaller = size[0] <= image.shape[0] and size[1] <= image.shape[1]
    mode = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (size[1], size[0]), interpolation=mode), np.float32)


def _enlarge(values: F32, size: Size) -> F32:
    return np.asarray(cv2.resize(values, (size[1], size[0]), interpolation=cv2.INTER_LINEAR), np.float32)


def _spread(total: F32, share: F32, mask: Mask, reach: int) -> tuple[F32, F32]:
    """Fill the rim between the last whole pixel of the network and the edge of the field of view."""
    if bool((share[mask] > 1e-3).all()):
        return total, share
    side = 2 * reach + 1
    near = cv2.boxFilter(share, -1, (side, side), borderType=cv2.BORDER_CONSTANT)
    blurred = cv2.boxFilter(total, -1, (side, side), borderType=cv2.BORDER_CONSTANT)
    empty = share <= 1e-3
    return np.where(empty, blurred, total), np.where(empty, near, share)
