"""OpenVLA's pictures, against what TensorFlow 2.15 made of the same ones, and its units."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray_models.openvla.prismatic import Statistics, crop_center, resize

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
            [
                [111, 49, 8],
                [190, 231, 136],
                [56, 20, 31],
                [199, 233, 230],
                [74, 19, 87],
                [120, 52, 225],
            ],
            [
                [167, 82, 13],
                [137, 231, 136],
                [36, 18, 37],
                [173, 231, 222],
                [65, 19, 86],
                [143, 82, 223],
            ],
        ),
        (
            (120, 160),
            [
                [94, 26, 0],
                [31, 227, 133],
                [163, 20, 31],
                [142, 231, 225],
                [35, 16, 81],
                [163, 218, 255],
            ],
            [
                [158, 89, 12],
                [48, 229, 135],
                [144, 18, 40],
                [106, 230, 218],
                [46, 17, 84],
                [188, 160, 241],
            ],
        ),
    ],
)
def test_pixels_are_tensorflows(
    size: tuple[int, int], small: list[list[int]], cropped: list[list[int]]
) -> None:
    picture = resize(scene(*size))
    assert picture.shape == (224, 224, 3)
    assert np.abs(picture[AT].astype(int) - small).max() <= 1
    assert np.abs(crop_center(picture)[AT].astype(int) - cropped).max() <= 1


def test_a_picture_of_the_right_size_is_not_compressed_again() -> None:
    picture = scene(224, 224)
    assert np.array_equal(resize(picture), picture)


ACTION = {
    "q01": [-1.0, 0.0],
    "q99": [3.0, 1.0],
    "min": [-2.0, 0.0],
    "max": [4.0, 1.0],
    "mask": [True, False],
}
ONE = {
    "libero_goal_no_noops": {"action": ACTION, "proprio": {"q01": [0.0, 5.0], "q99": [2.0, 5.0]}}
}


def test_masked_numbers_stay_as_they_are() -> None:
    scale = Statistics(ONE).scale("libero_goal_no_noops")
    assert scale.restore(np.array([[-1.0, 0.25], [0.0, 1.0], [1.0, 0.0]])).tolist() == [
        [-1, 0.25],
        [1, 1],
        [3, 0],
    ]
    assert scale.restore_spread(np.array([0.5, 0.5])).tolist() == [1.0, 0.5]


def test_bounds_may_be_the_smallest_and_largest() -> None:
    assert Statistics(ONE, "min_max").scale("libero_goal_no_noops").restore(
        np.ones(2)
    ).tolist() == [4.0, 1.0]


def test_states_beyond_their_range_are_at_its_end_and_those_that_never_moved_do_no_harm() -> None:
    scale = Statistics(ONE).scale("libero_goal_no_noops", "proprio")
    assert scale.normalise(np.array([9.0, 5.0])).tolist() == [1.0, -1.0]


def test_a_name_may_lack_its_ending_and_the_only_dataset_needs_none() -> None:
    statistics = Statistics(ONE)
    assert statistics.key("libero_goal") == statistics.key(None) == "libero_goal_no_noops"


def test_an_unknown_name_is_told_what_there_is() -> None:
    with pytest.raises(InvalidObservation, match=r"expected one of .*\['a', 'b'\], got None"):
        Statistics({"a": {}, "b": {}}).key(None)
    with pytest.raises(ConfigError, match=r"action: expected 'q01' and 'q99', got \[\]"):
        Statistics({"a": {}}).scale("a")


def test_fine_tunings_statistics_go_before_the_base_models(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"norm_stats": {"base": {}}}))
    assert Statistics.from_folder(tmp_path).key(None) == "base"
    (tmp_path / "dataset_statistics.json").write_text(json.dumps(ONE))
    assert Statistics.from_folder(tmp_path).key(None) == "libero_goal_no_noops"


@pytest.mark.parametrize(
    ("content", "says"), [("{", "is no JSON .*; copy it again"), ("[3]", "got no normalisation")]
)
def test_damaged_statistics_are_refused(tmp_path: Path, content: str, says: str) -> None:
    (tmp_path / "dataset_statistics.json").write_text(content)
    with pytest.raises(ConfigError, match=says):
        Statistics.from_folder(tmp_path)
