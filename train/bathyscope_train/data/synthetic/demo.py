"""The clip that ships with the client: ``python -m bathyscope_train.data.synthetic.demo demo.mp4``.

One rendered colonoscopy-like passage, the same picture for the same seed. Needs PyAV, which the
``client`` extra brings.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
import typer

from bathyscope_train.data.synthetic.clip import render_clip
from bathyscope_train.data.synthetic.domain import CameraRanges, Domain, MaterialRanges, SensorRanges

DEMO = Domain(
    name="demo",
    families={"lumen": 1.0},
    material=MaterialRanges(
        green_over_red=(0.24, 0.34), mottle=(0.06, 0.12), specular=(0.2, 0.4), vessels=(35.0, 55.0)
    ),
    camera=CameraRanges(fov_deg=(85.0, 95.0), speed=(0.8, 0.9), motions={"forward": 1.0}),
    sensor=SensorRanges(lag=(0.4, 0.5), vignette=(0.2, 0.3), noise=(0.003, 0.004), blurred=0.0),
)
"""A calm way through a colon in good light."""

SEED = 0


def write_video(path: Path, frames: npt.NDArray[np.uint8], *, rate: int = 15, quality: int = 18) -> None:
    """Write frames ``(t, h, w, 3)`` as H.264 in an mp4.

    Args:
        path: The file.
        frames: RGB, even height and width.
        rate: Frames a second.
        quality: Constant rate factor of the encoder; lower is better and larger.
    """
    import av

    with av.open(str(path), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": str(quality), "preset": "slow"})
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def main(
    path: Annotated[Path, typer.Argument(dir_okay=False, help="The mp4 to write.")],
    seed: Annotated[int, typer.Option(min=0)] = SEED,
    frames: Annotated[int, typer.Option(min=1)] = 60,
    height: Annotated[int, typer.Option(min=32)] = 256,
    width: Annotated[int, typer.Option(min=32)] = 320,
) -> None:
    """Render the demo clip."""
    write_video(path, render_clip(seed, DEMO, frames=frames, size=(height, width)).frames)
    typer.echo(f"{path}: {frames} frames, {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    typer.run(main)
