"""Blurs and resamplings of whole images as products with matrices, which is exact at the borders and quick anywhere.

A separable filter of an image is ``rows @ image @ columns.T``. The matrices are small (a side of the image squared) and
made on the CPU, one for every image of a batch.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float
from torch import Tensor

Array = npt.NDArray[np.float64]


def filter_images(
    images: Float[Tensor, "b ... h w"], rows: Float[Tensor, "b g h"], columns: Float[Tensor, "b k w"]
) -> Float[Tensor, "b ... g k"]:
    """Apply one separable filter to each image of a batch and all its channels."""
    between = (1,) * (images.ndim - 3)
    rows = rows.view(len(rows), *between, *rows.shape[1:])
    columns = columns.view(len(columns), *between, *columns.shape[1:])
    return rows @ images @ columns.transpose(-1, -2)


def blur(images: Float[Tensor, "b ... h w"], sigmas: Sequence[float], *, border: str = "mirror") -> Tensor:
    """Gaussian blur, another one for each image of a batch; 0 leaves an image as it is. OpenCV's for floats.

    Args:
        images: Any number of channels or frames an image.
        sigmas: Standard deviations in pixels.
        border: ``mirror`` about the outermost pixels (OpenCV's default), ``reflect`` about the edge, or ``nearest``.
    """
    if max(sigmas) == 0:
        return images
    height, width = images.shape[-2:]
    rows, columns = ([blur_matrix(size, sigma, border) for sigma in sigmas] for size in (height, width))
    return filter_images(images, stacked(rows, images), stacked(columns, images))


def stacked(matrices: Sequence[Array], like: Tensor) -> Float[Tensor, "b g h"]:
    """Matrices of a batch, on the device of ``like``."""
    return torch.from_numpy(np.stack(matrices)).to(like)


def blur_matrix(size: int, sigma: float, border: str = "mirror", *, radius: int | None = None) -> Array:
    """The matrix ``(size, size)`` of a Gaussian blur along one axis.

    Args:
        size: Samples.
        sigma: Standard deviation in samples; 0 is no blur.
        border: See :func:`blur`.
        radius: Where it is cut; at four standard deviations, as OpenCV does, if not said.
    """
    if sigma == 0:
        return np.eye(size)
    radius = (round(sigma * 8 + 1) | 1) // 2 if radius is None else radius
    taps = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    matrix = np.zeros((size, size + 2 * radius))
    for row in range(size):
        matrix[row, row : row + 2 * radius + 1] = taps / taps.sum()
    folded = np.zeros((size, size))
    np.add.at(folded.T, _fold(np.arange(-radius, size + radius), size, border), matrix.T)
    return folded


def sampling_matrix(places: npt.NDArray[np.floating], size: int) -> Array:
    """The matrix ``(n, size)`` of linear interpolation at ``places`` (0 is the first sample); the border repeats."""
    places = np.clip(places, 0, size - 1)
    low = np.minimum(places.astype(np.int64), max(size - 2, 0))
    matrix = np.zeros((len(places), size))
    every = np.arange(len(places))
    matrix[every, low] = 1 - (places - low)
    matrix[every, np.minimum(low + 1, size - 1)] += places - low
    return matrix


def mean_matrix(size: int, smaller: int) -> Array:
    """The matrix ``(smaller, size)`` of means over equal parts of an axis."""
    edges = np.arange(smaller + 1) * size / smaller
    samples = np.arange(size)
    cover = np.minimum(edges[1:, None], samples + 1) - np.maximum(edges[:-1, None], samples)
    return np.asarray(np.clip(cover, 0, None) * smaller / size, np.float64)


def _fold(index: npt.NDArray[np.int64], size: int, border: str) -> npt.NDArray[np.int64]:
    """Where samples beyond the border are taken from."""
    if border == "nearest" or size == 1:
        return np.clip(index, 0, size - 1)
    period = 2 * size - 2 if border == "mirror" else 2 * size
    index = index % period
    return np.where(index < size, index, period - index - (border != "mirror"))
