"""What the camera's electronics do to the picture: noise, white balance, sharpening, compression, writing."""

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]

_BLOCK = 8


def white_balance(warmth: float, tint: float) -> Array:
    """Gains of red, green and blue, ``(3,)``, whose product is 1.

    Args:
        warmth: Logarithm of red over blue.
        tint: Logarithm of green over the geometric mean of red and blue.
    """
    return np.asarray(np.exp([warmth / 2 - tint / 3, 2 * tint / 3, -warmth / 2 - tint / 3]), np.float32)


def colour_noise(grain: Array, grain_px: float, chroma: float) -> Array:
    """Give white noise ``(h, w, 3)`` the look of demosaicing, at the same standard deviation of its brightness.

    The mean of the three channels is blurred by ``grain_px``, the differences to it by twice that and scaled by
    ``chroma``; both keep their standard deviation.
    """
    if grain_px == 0 and chroma == 1:
        return grain
    grey = np.repeat(grain.mean(axis=-1, keepdims=True), 3, axis=-1)
    return _even_blur(grey, grain_px) + np.float32(chroma) * _even_blur(grain - grey, 2 * grain_px)


def _even_blur(noise: Array, sigma: float) -> Array:
    """Blur white noise and make up for the contrast lost: a kernel k leaves the root of the sum of k^2."""
    if sigma < 0.2:
        return noise
    kernel = cv2.getGaussianKernel(2 * int(np.ceil(3 * sigma)) + 1, sigma, cv2.CV_32F)
    left = float((kernel**2).sum())
    return np.asarray(cv2.sepFilter2D(noise, -1, kernel, kernel) / np.float32(left), np.float32)


def sharpen(level: Array, strength: float, sigma: float) -> Array:
    """Unsharp masking: add ``strength`` times the difference to a blurred copy; edges get halos."""
    return np.asarray(level + np.float32(strength) * (level - cv2.GaussianBlur(level, (0, 0), sigma)), np.float32)


def part_colours(light: Array, fringe_px: float) -> Array:
    """Lateral colour of a lens: red grows and blue shrinks by ``fringe_px`` at the left and right border."""
    height, width = light.shape[:2]
    parted = light.copy()
    for channel, sign in ((0, 1.0), (2, -1.0)):
        scale = 1.0 - sign * fringe_px / (width / 2)
        shift = np.array([[scale, 0, (1 - scale) * (width - 1) / 2], [0, scale, (1 - scale) * (height - 1) / 2]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        plane = np.ascontiguousarray(light[..., channel])
        parted[..., channel] = cv2.warpAffine(
            plane, shift, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
    return parted


def scatter(light: Array, share: float) -> Array:
    """Glare: ``share`` of the light is spread over a tenth of the image's width; the sum stays."""
    height, width = light.shape[:2]
    small = cv2.resize(light, (max(width // 4, 1), max(height // 4, 1)), interpolation=cv2.INTER_AREA)
    wide = cv2.GaussianBlur(small, (0, 0), max(width / 40, 0.5), borderType=cv2.BORDER_REFLECT)
    wide = cv2.resize(wide, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray((1 - np.float32(share)) * light + np.float32(share) * wide, np.float32)


def compress(frame: Bytes, quality: int) -> Bytes:
    """The frame after JPEG of ``quality``."""
    coded = cv2.imencode(".jpg", frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    decoded = cv2.imdecode(coded, cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(decoded[..., ::-1], np.uint8)


def hold_blocks(frame: Bytes, before: Bytes, threshold: float) -> Bytes:
    """Keep the blocks of the frame ``before`` that changed by less than ``threshold`` levels, as video coders do."""
    height, width = frame.shape[:2]
    change = np.abs(frame.astype(np.float32) - before).mean(axis=-1)
    change = np.pad(change, ((0, -height % _BLOCK), (0, -width % _BLOCK)), mode="edge")
    blocks = change.reshape(change.shape[0] // _BLOCK, _BLOCK, change.shape[1] // _BLOCK, _BLOCK).mean(axis=(1, 3))
    still = np.kron(blocks < threshold, np.ones((_BLOCK, _BLOCK), np.bool_))[:height, :width]
    return np.where(still[..., None], before, frame)


def writing(random: np.random.Generator, size: tuple[int, int]) -> Array:
    """Brightness of a few words and numbers near the corners, ``(h, w)``, as recordings carry them."""
    height, width = size
    canvas = np.zeros(size, np.uint8)
    scale = 0.25 * width / 140
    for _ in range(int(random.integers(1, 5))):
        text = "".join(random.choice(list("0123456789:/-. AEX"), int(random.integers(3, 9))))
        left = int(random.choice([0.01, 0.8]) * width)
        bottom = int(random.uniform(0.08, 0.98) * height)
        shade = int(random.integers(110, 250))
        cv2.putText(canvas, text, (left, bottom), cv2.FONT_HERSHEY_SIMPLEX, scale, shade, 1, cv2.LINE_AA)
    return np.asarray(canvas / np.float32(255), np.float32)
