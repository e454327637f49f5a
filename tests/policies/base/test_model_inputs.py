"""Images of any size, centred on black, and the cached tokens of instructions."""

from __future__ import annotations

import numpy as np

from vlagents_ray.policies.base.model_inputs import (
    KEPT,
    KEPT_CHARACTERS,
    keeping_tokens,
    resize_with_pad,
)


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


def test_few_instructions_are_kept_and_none_that_is_very_long() -> None:
    asked: list[str] = []
    tokens = keeping_tokens(lambda text: asked.append(text) or [len(text)])
    long = "a" * (KEPT_CHARACTERS + 1)
    for text in ("lift", "lift", long, long):
        assert tokens(text) == [len(text)]
    assert asked == ["lift", long, long]
    for number in range(KEPT):
        tokens(f"lift {number}")
    tokens("lift")
    assert asked.count("lift") == 2, "the least recently used entry must be dropped"
