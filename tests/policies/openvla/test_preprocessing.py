"""Pictures as OpenVLA's training data were, against what TensorFlow 2.15 made of the same ones."""

from __future__ import annotations

import numpy as np
import pytest

from vlagents_ray.policies.openvla.prismatic import middle, resized

AT = ([0, 3, 57, 111, 160, 223], [0, 120, 31, 200, 77, 223])


def scene(height: int, width: int) -> np.ndarray:
    """Waves, an edge and a gradient."""
    y, x = np.mgrid[0:height, 0:width]
    waves = 128 + 100 * np.sin(x / 5) * np.cos(y / 7)
    edge = np.where(x * height > y * width, 230, 20)
    return np.stack([waves, edge, x * 255 // width], -1).astype(np.uint8)


@pytest.mark.parametrize(
    ("size", "small", "cropped"),
    [
        (
            (256, 256),
            [[111, 49, 8], [190, 231, 136], [56, 20, 31], [199, 233, 230], [74, 19, 87], [120, 52, 225]],
            [[167, 82, 13], [137, 231, 136], [36, 18, 37], [173, 231, 222], [65, 19, 86], [143, 82, 223]],
        ),
        (
            (120, 160),
            [[94, 26, 0], [31, 227, 133], [163, 20, 31], [142, 231, 225], [35, 16, 81], [163, 218, 255]],
            [[158, 89, 12], [48, 229, 135], [144, 18, 40], [106, 230, 218], [46, 17, 84], [188, 160, 241]],
        ),
    ],
)
def test_pixels_are_tensorflows(size: tuple[int, int], small: list[list[int]], cropped: list[list[int]]) -> None:
    picture = resized(scene(*size))
    assert picture.shape == (224, 224, 3)
    assert np.abs(picture[AT].astype(int) - small).max() <= 1
    assert np.abs(middle(picture)[AT].astype(int) - cropped).max() <= 1


def test_a_picture_of_the_right_size_is_not_compressed_again() -> None:
    picture = scene(224, 224)
    assert np.array_equal(resized(picture), picture)
