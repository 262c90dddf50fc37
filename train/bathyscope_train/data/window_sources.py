"""Where training windows come from: folders of rendered clips, and domains that are rendered while it trains."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from bathyscope.errors import SettingsError
from bathyscope_train.config import RenderSettings, SourceSettings
from bathyscope_train.data.rendered_windows import RenderedPool
from bathyscope_train.data.synthetic.domain import Domain
from bathyscope_train.data.synthetic.domains import DOMAINS
from bathyscope_train.data.truth_clips import read_truth_clips
from bathyscope_train.data.windows import Batch, TruthClip, sample_window, stack, to_device
from bathyscope_train.schedule import source_shares

_SEEDS = 10_000_000  # scenes of a run begin at a multiple of it: those of folders and validation lie below


class WindowSources:
    """All sources of a run; a folder is read, and a pool is rendered, when it is first in use."""

    def __init__(
        self,
        sources: Sequence[SourceSettings],
        render: RenderSettings,
        *,
        device: torch.device,
        seed: int = 0,
        step: int = 0,
    ) -> None:
        """Remember what to use.

        Args:
            sources: With their shares.
            render: How clips of domains are rendered.
            device: Where batches go.
            seed: Of the run.
            step: At which the run goes on; its scenes are not those of the steps before.
        """
        self.sources, self.render, self.device = sources, render, device
        self.first_seed = _SEEDS * (seed + 1) + step * render.fresh
        self.folders: dict[Path, list[TruthClip]] = {}
        self.pools: dict[str, RenderedPool] = {}

    def draw(self, progress: float, random: np.random.Generator, count: int, *, frames: int) -> Batch:
        """Windows for one step.

        Args:
            progress: Of training, which decides what sources are in use.
            random: Source of every choice.
            count: Windows.
            frames: Frames of each.

        Raises:
            DatasetError: If a folder holds no clips.
            SettingsError: If a domain cannot be rendered.
        """
        shares = source_shares(self.sources, progress)
        windows, rendered = [], dict.fromkeys((source.domain for source in self.sources if source.domain), 0)
        for _ in range(count):
            source = self.sources[int(random.choice(len(shares), p=shares))]
            if source.domain is not None:
                rendered[source.domain] += 1
            else:
                clips = self._clips(source)
                windows.append(sample_window(clips[int(random.integers(len(clips)))], random, frames=frames))
        parts = [to_device(stack(windows), self.device)] if windows else []
        for domain, number in rendered.items():
            if number:
                parts.append(self._pool(domain).draw(random, number, frames=frames))
        return stack(parts)

    def close(self) -> None:
        """End what runs beside this process."""
        for pool in self.pools.values():
            pool.close()

    def _clips(self, source: SourceSettings) -> list[TruthClip]:
        assert source.folder is not None
        if source.folder not in self.folders:
            self.folders[source.folder] = read_truth_clips(source.folder)
        return self.folders[source.folder]

    def _pool(self, name: str) -> RenderedPool:
        """The pool of a domain, with some clips renewed since the last step."""
        if name in self.pools:
            self.pools[name].renew()
        else:
            domain = named_domain(name)
            self.pools[name] = RenderedPool(domain, self.render, device=self.device, first_seed=self.first_seed)
        return self.pools[name]


def named_domain(name: str) -> Domain:
    """A named domain, or one from a JSON file.

    Raises:
        SettingsError: If there is neither.
    """
    if name in DOMAINS:
        return DOMAINS[name]
    path = Path(name)
    if not path.is_file():
        raise SettingsError(f"{name!r} is neither a domain ({', '.join(DOMAINS)}) nor a file of one")
    return Domain.from_file(path)
