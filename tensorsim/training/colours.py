"""Random changes of light, colour and quality, as between cameras and video files; compositing of cut-outs."""

from typing import Any

import numpy as np
import numpy.typing as npt

Picture = npt.NDArray[np.uint8]


def recoloured(image: Picture, rng: np.random.Generator) -> Picture:
    """Random exposure, contrast, tint and saturation; sometimes dark, blurred, noisy, compressed, or grey."""
    import cv2

    ramp = np.linspace(0, 1, 256)
    gain = np.exp(rng.normal(0, 0.15)) * np.exp(rng.normal(0, 0.05, 3))
    if rng.random() < 0.08:
        gain = gain * rng.uniform(0.2, 0.6)
    table = ramp[:, None] ** np.exp(rng.normal(0, 0.2)) * gain + rng.normal(0, 0.04)
    image = cv2.LUT(image, np.clip(table * 255, 0, 255).astype(np.uint8)[None]).astype(np.uint8)
    saturation = 0.0 if rng.random() < 0.05 else rng.uniform(0.4, 1.5)
    mix = saturation * np.eye(3) + (1 - saturation) * np.array([[0.299, 0.587, 0.114]] * 3)
    image = cv2.transform(image, mix).astype(np.uint8)
    if rng.random() < 0.15:
        image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.5)).astype(np.uint8)
    if rng.random() < 0.15:
        noise = rng.integers(-128, 128, (*image.shape[:2], 1)) * rng.uniform(0.02, 0.12)
        image = np.clip(image + noise, 0, 255).astype(np.uint8)
    if rng.random() < 0.15:
        image = compressed(image, int(rng.integers(15, 60)))
    return image


def compressed(image: Picture, quality: int) -> Picture:
    """A picture (h, w, 3) after JPEG compression of a quality from 1 to 100."""
    import cv2

    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    decoded: Any = cv2.imdecode(data, cv2.IMREAD_COLOR)  # both use the same channel order
    return decoded.astype(np.uint8, copy=False)


def premultiplied(rgba: Picture) -> Picture:
    """A cut-out (h, w, 4) of straight alpha with its colours multiplied by alpha, ready for interpolation."""
    alpha = rgba[..., 3:].astype(np.uint16)
    return np.concatenate([(rgba[..., :3] * alpha + 127) // 255, alpha], -1).astype(np.uint8)


def over(image: Picture, cutout: Picture) -> Picture:
    """A picture (h, w, 3) with a cut-out (h, w, 4) from :func:`premultiplied` in front of it."""
    rest = 255 - cutout[..., 3:].astype(np.uint16)
    return np.minimum(cutout[..., :3] + (image * rest + 127) // 255, 255).astype(np.uint8)
