"""Preprocessing of images as in OpenVLA's training data: through JPEG, resized by Lanczos, and cropped to the centre.

Upstream does this with TensorFlow (experiments/robot/libero/libero_utils.py, experiments/robot/openvla_utils.py). Here
the resampling is two products with small matrices. The JPEG's pixels equal TensorFlow's; of the others fewer than one
in a thousand is off by one (TensorFlow 2.15, images of 128 to 640 px).
"""

from __future__ import annotations

import io
from functools import lru_cache

import numpy as np
import simplejpeg

from vlagents_ray.registry import require

SIDE = 224  # px; the size of all images in OpenVLA's training data
CROP_AREA = 0.9  # share of the area that the random crops of training kept
_LOBES = 3  # of the Lanczos kernel


def resized(image: np.ndarray) -> np.ndarray:
    """Resize an (H, W, 3) uint8 image to (224, 224, 3) by JPEG of quality 95 and Lanczos; that size stays unchanged."""
    height, width = image.shape[:2]
    if (height, width) == (SIDE, SIDE):
        return image
    pixels = _apply(_lanczos(height), _lanczos(width), _through_jpeg(image).astype(np.float32))
    return _uint8(np.round(pixels), 255)


def middle(image: np.ndarray) -> np.ndarray:
    """Crop the central nine tenths of the area of an (H, W, 3) uint8 image, and scale them to (224, 224, 3)."""
    height, width = image.shape[:2]
    pixels = _apply(_crop(height), _crop(width), image.astype(np.float32) / 255)
    return _uint8(pixels * 255.5, 255.5)  # TensorFlow's conversion: add a half, then truncate


def _uint8(pixels: np.ndarray, most: float) -> np.ndarray:
    return np.asarray(np.clip(pixels, 0, most), np.uint8)


def _through_jpeg(image: np.ndarray) -> np.ndarray:
    """Compress and decompress the image by the algorithms that TensorFlow chooses.

    Its encoder is Pillow's exact one, its decoder the fast one; simplejpeg's encoder would be off by up to 18.
    """
    file = io.BytesIO()
    require("PIL.Image").fromarray(image).save(file, "JPEG", quality=95, subsampling="4:2:0")
    decoded: np.ndarray = simplejpeg.decode_jpeg(file.getvalue(), "RGB", fastdct=True, fastupsample=False)
    return decoded


def _apply(rows: np.ndarray, columns: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Resample (H, W, 3) by (224, H) and (224, W) weights."""
    turned = np.tensordot(rows, image, (1, 0))  # (224, W, 3)
    return np.asarray(np.tensordot(turned, columns, (1, 1)).transpose(0, 2, 1))


@lru_cache(maxsize=16)
def _lanczos(size: int) -> np.ndarray:
    """Return weights (224, size); kernels are wider where the image shrinks, so that it does not alias."""
    scale = size / SIDE
    centres = (np.arange(SIDE) + 0.5) * scale
    x = ((np.arange(size) + 0.5) - centres[:, None]) / max(scale, 1.0)
    weights = np.where(np.abs(x) < _LOBES, np.sinc(x) * np.sinc(x / _LOBES), 0.0)
    return np.asarray(weights / weights.sum(1, keepdims=True), np.float32)


@lru_cache(maxsize=16)
def _crop(size: int) -> np.ndarray:
    """Return weights (224, size) that scale the centre up, by linear interpolation between the two nearest pixels."""
    side = CROP_AREA**0.5
    at = (1 - side) / 2 * (size - 1) + np.arange(SIDE) * (side * (size - 1) / (SIDE - 1))
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(np.arange(size) - at[:, None])), np.float32)
