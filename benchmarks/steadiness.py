"""How steady depth is: on a camera that stands still, and across the borders of windows.

    python benchmarks/steadiness.py sinus/clip.mp4 [--bundle FOLDER]

*Still*: one frame of the video, repeated, each time with new sensor noise. Printed is the standard deviation over time
of log depth, in per cent: the median pixel and the 95th percentile, and that of the frame's median depth (a breathing
scale). The same noise on the network's single frame has no windows to steady it (`head`).

*Jumps*: the video as it is. Between neighbouring frames, the median change of log depth over pixels: its mean over the
video, and its 95th percentile over its median. Where windows do not join, the latter is large.
"""

import argparse
import json
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from bathyscope.bundle import Bundle, shipped_bundle
from bathyscope.clip import Clip
from bathyscope.engines import DepthOptions
from bathyscope_serve.engine import DepthEngine
from bathyscope_serve.engine_settings import EngineSettings, PaceSettings


def read_clip(path: Path) -> Clip:
    """All frames of a video."""
    with av.open(str(path)) as container:
        frames = np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])
    return Clip(frames, np.arange(len(frames)) / 25, path.name)


def depths(engine: DepthEngine, clip: Clip, options: DepthOptions) -> NDArray[np.float32]:
    """(t, h, w) log depth; NaN where nothing is known."""
    frames = []
    for frame in engine.run(clip, options):
        known = frame.valid & (frame.depth > 0)
        frames.append(np.log(np.where(known, frame.depth, np.nan)).astype(np.float32))
    return np.stack(frames)


def still(engine: DepthEngine, image: NDArray[np.uint8], count: int, noise: float) -> dict[str, dict[str, float]]:
    """Standard deviations over time, in per cent, on one frame with fresh noise."""
    random = np.random.default_rng(0)
    shape = (count, *image.shape)
    frames = np.clip(image + random.normal(0, noise, shape).astype(np.float32), 0, 255).round().astype(np.uint8)
    clip = Clip(frames, np.arange(count) / 25, "still")
    found = {}
    for name, options in (("rendered", DepthOptions()), ("head", DepthOptions(depth="head"))):
        log_depth = depths(engine, clip, options)
        spread = 100 * log_depth[:, np.isfinite(log_depth).all(0)].std(0)
        found[name] = {
            "median_percent": round(float(np.median(spread)), 3),
            "p95_percent": round(float(np.percentile(spread, 95)), 3),
            "scale_percent": round(float(100 * np.nanmedian(log_depth, axis=(1, 2)).std()), 3),
        }
    return found


def jumps(engine: DepthEngine, clip: Clip) -> dict[str, float]:
    """Change between neighbouring frames."""
    change = 100 * np.nanmedian(np.abs(np.diff(depths(engine, clip, DepthOptions()), axis=0)), axis=(1, 2))
    high, middle = float(np.percentile(change, 95)), float(np.median(change))
    return {"change_percent": round(float(change.mean()), 3), "p95_over_median": round(high / middle, 3)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("video", type=Path)
    parser.add_argument("--bundle", type=Path, help="folder or .zip; the shipped bundle unless given")
    parser.add_argument("--frames", type=int, default=48, help="of the still clip")
    parser.add_argument("--longest", type=int, default=PaceSettings().longest, help="frames between key frames")
    parser.add_argument("--noise", type=float, default=2.0, help="standard deviation, grey levels of 255")
    options = parser.parse_args()
    bundle = Bundle.open(options.bundle or shipped_bundle())
    engine = DepthEngine(bundle, EngineSettings(pace=PaceSettings(longest=options.longest)))
    clip = read_clip(options.video)
    print(
        json.dumps(
            {
                "video": options.video.name,
                "still": still(engine, clip.frames[0], options.frames, options.noise),
                "jumps": jumps(engine, clip),
            }
        )
    )


if __name__ == "__main__":
    main()
