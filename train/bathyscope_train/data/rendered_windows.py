"""Training windows straight from the renderer: a pool of clips on the device, renewed while windows are drawn."""

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from bathyscope_train.config import RenderSettings
from bathyscope_train.data.synthetic.domain import Domain
from bathyscope_train.data.synthetic.plan_stream import PlanJob, PlanStream
from bathyscope_train.data.synthetic.torch_clip import ClipBatch, render_plans
from bathyscope_train.data.windows import Augmentation, Batch, choose, crop_centre, draw_index, mirror, recolour, scaled

_CLIPS_AT_ONCE = 32


class RenderedPool:
    """Clips of one domain on a device, some of them replaced by new ones whenever asked."""

    def __init__(self, domain: Domain, settings: RenderSettings, *, device: torch.device, first_seed: int = 0) -> None:
        """Render the first clips.

        Args:
            domain: What to render.
            settings: How many, how long, how large.
            device: Where to render and keep them.
            first_seed: Of the first scene; the others count up from it.

        Raises:
            SettingsError: If the domain has what the renderer has not.
        """
        self.settings, self.device = settings, device
        job = PlanJob(domain, settings.frames, (settings.height, settings.width), settings.takes)
        self.stream = PlanStream(job, first_seed=first_seed, processes=settings.processes)
        self.generator = torch.Generator(device).manual_seed(first_seed)
        parts = [self._render(size) for size in _portions(settings.pool)]
        self.clips = {name: torch.cat([getattr(part, name) for part in parts]) for name in _tensors()}
        self.oldest = 0

    def renew(self) -> None:
        """Replace the oldest clips by new ones."""
        for size in _portions(self.settings.fresh):
            new = self._render(size)
            place = (self.oldest + torch.arange(size, device=self.device)) % self.settings.pool
            for name, values in self.clips.items():
                values.index_copy_(0, place, getattr(new, name))
            self.oldest = (self.oldest + size) % self.settings.pool

    def draw(
        self, random: np.random.Generator, count: int, *, frames: int, augmentation: Augmentation | None = None
    ) -> Batch:
        """Random windows of random clips, augmented as ``sample_window`` does.

        Args:
            random: Source of every choice.
            count: Windows.
            frames: Frames of each.
            augmentation: How far a window may be changed.
        """
        augmentation = augmentation or Augmentation()
        clips = torch.from_numpy(random.integers(self.settings.pool, size=count))[:, None].to(self.device)
        index = [draw_index(self.settings.frames, frames, random, augmentation.slow_chance) for _ in range(count)]
        batch = self._cut(clips, torch.tensor(index, device=self.device))
        for axis in (0, 1):
            flip = torch.from_numpy(random.random(count) < 0.5).to(self.device)
            batch = choose(flip, mirror(batch, axis=axis), batch)
        cropped = random.random(count) < augmentation.crop_chance
        share = np.where(cropped, random.uniform(augmentation.crop, 1.0, count), 1.0)
        batch = crop_centre(batch, torch.from_numpy(share).to(batch.depth))
        return recolour(batch, random, augmentation)

    def close(self) -> None:
        """End the processes that plan."""
        self.stream.close()

    def _render(self, count: int) -> ClipBatch:
        return render_plans(
            self.stream.take(count), device=self.device, generator=self.generator, compiled=self.settings.compiled
        )

    def _cut(self, clips: Int[Tensor, "b 1"], index: Int[Tensor, "b t"]) -> Batch:
        poses = self.clips["world_from_camera"][clips, index].double()
        return scaled(
            Batch(
                images=self.clips["frames"][clips, index].float() / 255,
                depth=self.clips["depth"][clips, index],
                valid=self.clips["valid"][clips, index],
                world_from_camera=(torch.linalg.inv(poses[:, :1]) @ poses).float(),
                focal=self.clips["intrinsics"][clips[:, 0], 0, 0],
                moving=self.clips["moving"][clips, index],
                distortion=self.clips["distortion"][clips[:, 0]],
            )
        )


def _tensors() -> list[str]:
    return [field.name for field in fields(ClipBatch) if field.name != "names"]


def _portions(count: int) -> Sequence[int]:
    """``count`` in parts that fit into memory at once."""
    return [min(_CLIPS_AT_ONCE, count - start) for start in range(0, count, _CLIPS_AT_ONCE)]
