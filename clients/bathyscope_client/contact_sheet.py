"""``NAME_sheet.png``: frames from all over the clip, each over its depth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import Size
from bathyscope.errors import ResultError
from bathyscope.result import FrameDepth
from bathyscope_client.depth_colours import ClipRange, colour_depth, inverse
from bathyscope_client.preview import pane_size

_TILES = 8
_COLUMNS = 4
_MOST_SIDE = 320
_MARGIN = 4
_CAPTION = 22


class SheetWriter:
    """Keeps eight small tiles until the end."""

    def __init__(self, path: Path, span: ClipRange, size: Size, scale: str) -> None:
        self._path, self._span, self._scale = path, span, scale
        self._size = pane_size(size, _MOST_SIDE)
        self._wanted = set(np.linspace(0, max(0, span.frames - 1), _TILES).round().astype(int).tolist())
        self._seen = 0
        self._tiles: list[NDArray[np.uint8]] = []

    def add(self, frame: FrameDepth, image: NDArray[np.uint8]) -> None:
        """Keep the frame if it is one of the eight."""
        if self._seen in self._wanted:
            self._tiles.append(self._tile(frame, image))
        self._seen += 1

    def close(self) -> None:
        """Write the sheet."""
        columns = min(_COLUMNS, len(self._tiles))
        blank = np.zeros_like(self._tiles[0])
        padded = self._tiles + [blank] * (-len(self._tiles) % columns)
        rows = [np.hstack(padded[i : i + columns]) for i in range(0, len(padded), columns)]
        sheet = np.vstack([*rows, self._legend(rows[0].shape[1])])
        done, data = cv2.imencode(".png", sheet[..., ::-1])
        if not done:
            raise ResultError(f"{self._path.name}: a sheet of shape {sheet.shape} cannot be encoded as PNG")
        self._path.write_bytes(data.tobytes())

    def abandon(self) -> None:
        """Give up."""
        self._tiles.clear()

    def _tile(self, frame: FrameDepth, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        h, w = self._size
        tile = np.zeros((2 * h + _CAPTION + _MARGIN, w + _MARGIN, 3), np.uint8)
        tile[:h, :w] = cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA)
        coloured = colour_depth(frame.depth, frame.valid, self._span)
        tile[h : 2 * h, :w] = cv2.resize(coloured, (w, h), interpolation=cv2.INTER_AREA)
        _write(tile, f"{frame.timestamp_s:.2f} s", (2, 2 * h + 15))
        return tile

    def _legend(self, width: int) -> NDArray[np.uint8]:
        unit = "mm" if self._scale == "mm" else f"({self._scale})"
        near, far = f"near {self._span.near:.3g} {unit}", f"{self._span.far:.3g} {unit} far"
        legend = np.zeros((2 * _CAPTION, width, 3), np.uint8)
        ramp = np.geomspace(max(self._span.near, 1e-12), max(self._span.far, 1e-12), width).astype(np.float32)
        values = inverse(ramp) if self._span.disparity else ramp
        bar = colour_depth(values[None], np.ones((1, width), np.bool_), self._span)
        legend[:_CAPTION] = bar
        _write(legend, near, (2, 2 * _CAPTION - 7))
        _write(legend, far, (max(2, width - 9 * len(far)), 2 * _CAPTION - 7))
        return legend


def _write(picture: NDArray[np.uint8], text: str, at: tuple[int, int]) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
