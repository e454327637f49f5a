"""The whole image, centred in black."""

from __future__ import annotations

import numpy as np

from vlagents_ray.policies.base.model_inputs import resize_with_pad


def test_a_wide_image_gets_bars_above_and_below() -> None:
    padded = resize_with_pad(np.full((50, 100, 3), 200, np.uint8), 224, 224)
    assert padded.shape == (224, 224, 3)
    assert (padded[56:168] == 200).all()
    assert not padded[:56].any()
    assert not padded[168:].any()


def test_a_tall_image_gets_bars_left_and_right() -> None:
    padded = resize_with_pad(np.full((100, 50, 3), 200, np.uint8), 224, 224)
    assert (padded[:, 56:168] == 200).all()
    assert not padded[:, :56].any()
    assert not padded[:, 168:].any()


def test_an_image_of_the_right_size_is_copied_as_it_is() -> None:
    image = np.random.default_rng(0).integers(0, 256, (224, 224, 3), dtype=np.uint8)
    same = resize_with_pad(image, 224, 224)
    np.testing.assert_array_equal(same, image)
    assert not np.shares_memory(same, image)


def test_a_sliver_keeps_a_row_of_pixels() -> None:
    assert resize_with_pad(np.full((1, 4000, 3), 9, np.uint8), 224, 224).any()
