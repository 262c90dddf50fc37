"""Vessel trees: random walks that branch and thin out, drawn on a map of the surface."""

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]
_SHIFT = 4  # fractional bits of cv2's coordinates


def vessel_map(
    random: np.random.Generator,
    size_mm: tuple[float, float],
    step_mm: float,
    trees: int,
    *,
    wrap: bool,
    width: float = 1.0,
) -> Array:
    """Density of vessels in [0, 1] on a map, ``(rows, columns)``.

    Args:
        random: Source of the walks.
        size_mm: Height and width of the map.
        step_mm: Size of one sample.
        trees: Number of trees.
        wrap: Whether the columns close to a ring.
        width: Width of the vessels against their usual 0.35 to 1.3 mm.
    """
    rows, columns = (max(8, round(length / step_mm)) for length in size_mm)
    canvas = np.zeros((rows, columns), np.uint8)
    for _ in range(trees):
        start = random.uniform((0, 0), size_mm)
        _grow(
            random,
            canvas,
            start / step_mm,
            random.uniform(0, 2 * np.pi),
            width * random.uniform(0.35, 1.3),
            step_mm=step_mm,
            wrap=wrap,
        )
    return np.asarray(np.asarray(cv2.GaussianBlur(canvas, (0, 0), 0.7), np.float32) / np.float32(255), np.float32)


def _grow(
    random: np.random.Generator,
    canvas: npt.NDArray[np.uint8],
    start: npt.NDArray[np.float64],
    heading: float,
    width_mm: float,
    *,
    step_mm: float,
    wrap: bool,
) -> None:
    """Draw one tree; its branches wait on a list rather than on the stack."""
    waiting = [(start, heading, width_mm)]
    for _ in range(24):
        if not waiting:
            return
        point, heading, width = waiting.pop()
        stretch = 1.6 / step_mm
        for _ in range(int(random.integers(8, 26))):
            heading += random.normal(0.0, 0.28)
            end = point + stretch * np.array([np.sin(heading), np.cos(heading)])
            _line(canvas, point, end, width / step_mm, wrap)
            point, width = end, width * 0.97
            if width > 0.22 and random.uniform() < 0.11:
                waiting.append((point, heading + random.choice([-1, 1]) * random.uniform(0.4, 1.1), width * 0.65))


def _line(
    canvas: npt.NDArray[np.uint8],
    start: npt.NDArray[np.float64],
    end: npt.NDArray[np.float64],
    width_px: float,
    wrap: bool,
) -> None:
    value = int(255 * min(1.0, width_px))
    columns = canvas.shape[1]
    shifts = (-columns, 0, columns) if wrap and not 4 < end[1] < columns - 4 else (0,)
    for shift in shifts:
        corners = [(int((point[1] + shift) * 2**_SHIFT), int(point[0] * 2**_SHIFT)) for point in (start, end)]
        cv2.line(canvas, corners[0], corners[1], value, max(1, round(width_px)), cv2.LINE_AA, _SHIFT)
