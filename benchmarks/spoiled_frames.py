"""A copy of a data set folder with frames that show nothing in between: what a splash, a blink or a fast turn leaves.

    python benchmarks/spoiled_frames.py rgbd_kitchen kitchen_blurred --every 4 --how blurred
    bathyscope evaluate kitchen_blurred

Every n-th frame, from the second on, is blurred by 1.2 % of its width, or black. Truth and poses stay as they are,
those of the spoiled frames included.
"""

import argparse
import shutil
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bathyscope_train.evaluation.folders import DatasetFolder


def spoiled(image: NDArray[np.uint8], how: str) -> NDArray[np.uint8]:
    """A frame (h, w, 3) that shows nothing, or next to nothing."""
    if how == "black":
        return np.zeros_like(image)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.012 * image.shape[1]), np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of a data set, with frames/, intrinsics.json and truth")
    parser.add_argument("out", type=Path)
    parser.add_argument("--every", type=int, default=4)
    parser.add_argument("--how", choices=("blurred", "black"), default="blurred")
    options = parser.parse_args()
    shutil.copytree(options.folder, options.out)
    data = DatasetFolder.open(options.out)
    for index in range(1, len(data.frames), options.every):
        image = spoiled(data.image(index), options.how)
        cv2.imwrite(str(data.frames[index]), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    print(f"{options.out}: {len(range(1, len(data.frames), options.every))} of {len(data.frames)} frames {options.how}")


if __name__ == "__main__":
    main()
