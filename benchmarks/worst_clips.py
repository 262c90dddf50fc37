"""Pictures of where a network fails: the clips with the largest errors of a folder, image, estimate and truth.

    python benchmarks/worst_clips.py CHECKPOINT clips/broad_val failures.png --count 6

Prints their names and AbsRel (one window of 8 frames, one scale for the window), the worst first, in the order of the
picture: down the first column, then the second.
"""

import argparse
import json
from pathlib import Path

from bathyscope_train.data.truth_clips import read_truth_clips
from bathyscope_train.model.checkpoints import load_network
from bathyscope_train.validation import validate, write_grid


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("clips", type=Path, help="folder of rendered clips")
    parser.add_argument("picture", type=Path)
    parser.add_argument("--count", type=int, default=6)
    options = parser.parse_args()
    network = load_network(options.checkpoint)[0].eval()
    measured = [validate(network, [clip]) for clip in read_truth_clips(options.clips)]
    worst = sorted(measured, key=lambda each: -each[0].abs_rel)[: options.count]
    write_grid(options.picture, [examples[0] for _, examples in worst])
    print(json.dumps({examples[0].name: round(found.abs_rel, 3) for found, examples in worst}))


if __name__ == "__main__":
    main()
