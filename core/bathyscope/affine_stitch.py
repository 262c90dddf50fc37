"""Bring the windows of a video depth network to one scale and shift, and hand out maps as they become final.

Works on the network's own values: disparity of relative networks, depth of metric ones. The first window is never
changed, so the scale of the whole video is that of its first window.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import GeometryError
from bathyscope.keyed_windows import KeyedWindows

F32 = NDArray[np.float32]


class AffineStitcher:
    """Takes the maps of each window in order; gives back those that no later window can change.

    Args:
        rule: How the windows were cut.
    """

    def __init__(self, rule: KeyedWindows) -> None:
        self._rule = rule
        self._open: list[F32] = []
        self._references: list[F32] = []
        self._real, self._given = 0, 0
        self.affine: list[tuple[float, float]] = []
        """Scale and shift of each window after the first, where the rule fits any."""

    def add(self, maps: F32, fresh: int) -> Iterator[F32]:
        """Add a window; gives the maps (h, w) that are final now, in order, without those of the padding.

        Args:
            maps: (n, h, w) values of every frame of the window.
            fresh: How many of its frames are real and new (:attr:`~bathyscope.keyed_windows.KeyedWindow.fresh`).

        Raises:
            GeometryError: If there are not as many maps as a window has frames.
        """
        rule = self._rule
        if maps.ndim != 3 or len(maps) != rule.length:
            raise GeometryError(f"a window has {rule.length} maps (h, w), got an array of shape {maps.shape}")
        if self._references:
            self._join(maps)
        else:
            self._references = [maps[place].copy() for place in self._reference_places]
            self._open = list(maps)
        self._real += fresh
        yield from self._give(len(self._open) - rule.blend)

    def finish(self) -> Iterator[F32]:
        """Everything that is left."""
        yield from self._give(len(self._open))

    @property
    def _reference_places(self) -> tuple[int, ...]:
        """Key places whose maps are kept to fit on; the first one's map is kept for ever."""
        rule = self._rule
        return rule.key_places[: max(1, rule.overlap - rule.blend)]

    def _join(self, maps: F32) -> None:
        """Carry a window over, and blend its leading frames into those that are not final yet."""
        rule = self._rule
        first = rule.overlap - rule.blend
        scale, shift = self._fit(maps)
        mapped = np.maximum(maps * np.float32(scale) + np.float32(shift), np.float32(0))
        for step, share in enumerate(np.linspace(0, 1, rule.blend, dtype=np.float32)):
            place = step - rule.blend
            self._open[place] = self._open[place] * (1 - share) + mapped[first + step] * share
        self._open.extend(mapped[rule.overlap :])
        self._references[1:] = [mapped[place].copy() for place in self._reference_places[1:]]

    def _fit(self, maps: F32) -> tuple[float, float]:
        rule = self._rule
        if rule.fit == "none":
            return 1.0, 0.0
        if rule.fit == "references":
            source, target = maps[: len(self._references)], np.stack(self._references)
        else:
            source, target = maps[rule.overlap - rule.blend : rule.overlap], np.stack(self._open[-rule.blend :])
        affine = fit_affine(source, target)
        self.affine.append(affine)
        return affine

    def _give(self, count: int) -> Iterator[F32]:
        """Hand out and forget the first ``count`` open maps."""
        final, self._open = self._open[: max(0, count)], self._open[max(0, count) :]
        for maps in final:
            if self._given < self._real:
                self._given += 1
                yield maps


def fit_affine(source: F32, target: F32) -> tuple[float, float]:
    """Scale and shift of least squared distance from ``source`` to ``target``, over all values; (1, 0) if undetermined.

    Sums are float32, as in the published programs.
    """
    count = np.float32(source.size)
    squares, total = np.sum(source * source), np.sum(source)
    products, wanted = np.sum(source * target), np.sum(target)
    determinant = squares * count - total * total
    if determinant == 0:
        return 1.0, 0.0
    scale = (count * products - total * wanted) / determinant
    shift = (squares * wanted - total * products) / determinant
    return float(scale), float(shift)
