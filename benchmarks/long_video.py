"""Peak memory of the engine on a short and a ten times longer video: python benchmarks/long_video.py.

Each video is written on the fly and goes from the file to a finished npz in a process of its own, as
`bathyscope depth` does it. Prints one JSON line; `ratio` is the longer video's peak over the shorter one's.
"""

import argparse
import json
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import av
import cv2
import numpy as np


def write_video(path: Path, frames: int, height: int, width: int) -> None:
    """A camera gliding over a smooth texture."""
    rng = np.random.default_rng(0)
    texture = cv2.resize(rng.uniform(50, 230, (24, 48, 3)), (4 * width, 2 * height), interpolation=cv2.INTER_CUBIC)
    texture = np.clip(texture, 40, 255).astype(np.uint8)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"preset": "veryfast"})
        stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
        for index in range(frames):
            x = int((1.5 * width) * (1 + np.sin(index / 60)))
            y = int((0.5 * height) * (1 + np.cos(index / 45)))
            image = np.ascontiguousarray(texture[y : y + height, x : x + width])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))


def measure(video: Path, bundle: Path | None, pixels: int | None) -> None:
    """Run one video and print what it took; peaks are of this process and of its largest child."""
    from bathyscope.bundle import Bundle, shipped_bundle
    from bathyscope.result_files import NpzWriter
    from bathyscope_serve.engine import DepthEngine
    from bathyscope_serve.engine_settings import EngineSettings

    engine = DepthEngine(Bundle.open(bundle or shipped_bundle()), EngineSettings(pixels=pixels))
    begun, cpu = time.perf_counter(), time.process_time()
    run = engine.run(video)
    with NpzWriter(video.with_suffix(".npz")) as writer:
        for frame in run:
            writer.append(frame)
        count = len(writer)
        writer.close(run.meta())
    peak = {who: resource.getrusage(who).ru_maxrss / 1024 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)}
    found = {
        "frames": count,
        "peak_rss_mb": round(peak[resource.RUSAGE_SELF], 1),
        "decoder_peak_rss_mb": round(peak[resource.RUSAGE_CHILDREN], 1),
        "seconds": round(time.perf_counter() - begun, 1),
        "cpu_s": round(time.process_time() - cpu, 1),
        "warnings": run.meta().warnings,
    }
    print(json.dumps(found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, nargs=2, default=[100, 1000])
    parser.add_argument("--height", type=int, default=144)
    parser.add_argument("--width", type=int, default=180)
    parser.add_argument("--bundle", type=Path, help="folder or .zip; the shipped bundle unless given")
    parser.add_argument("--pixels", type=int, help="area that the network sees; the bundle's unless given")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        measure(options.measure, options.bundle, options.pixels)
        return
    runs = []
    with tempfile.TemporaryDirectory() as folder:
        for frames in options.frames:
            video = Path(folder) / f"{frames}.mp4"
            write_video(video, frames, options.height, options.width)
            command = [sys.executable, __file__, "--measure", str(video)]
            for name in ("bundle", "pixels"):
                if getattr(options, name) is not None:
                    command += [f"--{name}", str(getattr(options, name))]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            runs.append(json.loads(done.stdout.splitlines()[-1]))
    result = {
        "benchmark": "long_video",
        "size": [options.height, options.width],
        "pixels": options.pixels,
        "runs": runs,
        "ratio": round(runs[1]["peak_rss_mb"] / runs[0]["peak_rss_mb"], 3),
        "machine": platform.processor() or platform.machine(),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
