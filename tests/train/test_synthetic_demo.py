"""The shipped clip is small, plays, and comes from its script."""

from pathlib import Path

import av
import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic import render_clip
from bathyscope_train.data.synthetic.demo import DEMO, SEED, write_video

ASSET = Path(__file__).parents[2] / "clients" / "bathyscope_client" / "assets" / "demo.mp4"


def decoded(path: Path) -> npt.NDArray[np.uint8]:
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def test_video_shows_the_frames_it_was_written_from(tmp_path: Path) -> None:
    frames = render_clip(SEED, DEMO, frames=4, size=(64, 80)).frames
    write_video(tmp_path / "clip.mp4", frames)
    shown = decoded(tmp_path / "clip.mp4")
    assert shown.shape == frames.shape
    assert np.abs(shown.astype(float) - frames).mean() < 8


def test_the_shipped_clip_is_the_one_of_the_script() -> None:
    assert ASSET.stat().st_size < 1_000_000
    shipped = decoded(ASSET)
    assert shipped.shape == (60, 256, 320, 3)
    first = render_clip(SEED, DEMO, frames=60, size=(16, 20)).frames[[0, -1]]
    coarse = shipped[[0, -1]].reshape(2, 16, 16, 20, 16, 3).mean(axis=(2, 4))
    assert np.corrcoef(coarse.ravel(), first.ravel())[0, 1] > 0.95
