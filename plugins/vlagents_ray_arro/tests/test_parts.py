"""The parts of ARRO that need no weights, on drawn images."""

from __future__ import annotations

import numpy as np
import pytest

from vlagents_ray.errors import ConfigError
from vlagents_ray_arro.parts import (
    bounding_box,
    connected_regions,
    grown,
    label_flat,
    label_linked,
    make_part,
    overlap,
)
from vlagents_ray_arro.wrapper import Background, BackgroundConfig

GREY, RED, BLUE = (200, 200, 200), (220, 40, 40), (40, 60, 220)


def canvas(*rectangles: tuple[tuple[int, int, int], slice, slice]) -> np.ndarray:
    image = np.full((60, 80, 3), GREY, np.uint8)
    for colour, rows, columns in rectangles:
        image[rows, columns] = colour
    return image


def mask_at(rows: slice, columns: slice) -> np.ndarray:
    mask = np.zeros((60, 80), bool)
    mask[rows, columns] = True
    return mask


def test_pixels_are_connected_by_chains_of_links_alone() -> None:
    spiral = np.array(
        [[1, 1, 1, 1], [0, 0, 0, 1], [1, 1, 0, 1], [1, 0, 0, 1], [1, 1, 1, 1], [0, 0, 0, 0]], bool
    )
    labels = label_linked(spiral[:, :-1] & spiral[:, 1:], spiral[:-1] & spiral[1:])
    assert len(set(labels[spiral])) == 1
    # Pixels outside of the mask are not linked.
    assert len(set(labels[~spiral])) == np.count_nonzero(~spiral)


def test_a_mask_splits_into_its_regions_without_the_small_ones() -> None:
    mask = (
        mask_at(slice(0, 10), slice(0, 10))
        | mask_at(slice(20, 40), slice(5, 9))
        | mask_at(slice(50, 51), slice(5, 6))
    )
    assert [int(region.sum()) for region in connected_regions(mask, smallest=2)] == [100, 80]


def test_a_gradient_is_one_flat_region_and_a_step_divides() -> None:
    image = np.repeat(np.arange(0, 160, 2, dtype=np.uint8)[None, :, None], 60, 0).repeat(3, 2)
    assert len(np.unique(label_flat(image, tolerance=2))) == 1
    image[:, 40:] += 20
    assert len(np.unique(label_flat(image, tolerance=2))) == 2


def test_a_grown_mask_is_wider_by_so_many_pixels() -> None:
    mask = mask_at(slice(20, 30), slice(0, 10))
    assert np.array_equal(grown(mask, 3), mask_at(slice(17, 33), slice(0, 13)))
    assert np.array_equal(grown(mask, 0), mask)


def test_overlap_is_intersection_over_union() -> None:
    left, right = mask_at(slice(0, 10), slice(0, 10)), mask_at(slice(0, 10), slice(5, 15))
    assert overlap(left, right) == pytest.approx(50 / 150)
    assert overlap(np.zeros_like(left), np.zeros_like(left)) == 0


def test_colours_are_found_by_the_words_of_a_phrase() -> None:
    image = canvas(
        (RED, slice(10, 20), slice(10, 20)),
        (RED, slice(40, 45), slice(0, 5)),
        (BLUE, slice(5, 9), slice(50, 60)),
    )
    red, blue = make_part("detector", "colour").detect(
        [image, image], [["put the RED cube down"], ["blue", "a cube"]]
    )
    assert [detection.box.tolist() for detection in red] == [[10, 10, 20, 20], [0, 40, 5, 45]]
    [blue_cube] = blue
    assert (blue_cube.phrase, blue_cube.box.tolist()) == ("blue", [50, 5, 60, 9])
    assert np.array_equal(blue_cube.mask, mask_at(slice(5, 9), slice(50, 60)))


def test_a_region_that_reaches_out_of_a_box_is_not_its_object() -> None:
    image = canvas((RED, slice(10, 20), slice(10, 20)))
    [masks] = make_part("segmenter", "flat").segment(
        [image], [np.array([[5, 5, 25, 25], [30, 30, 40, 40]], np.float32)]
    )
    assert np.array_equal(masks[0], mask_at(slice(10, 20), slice(10, 20)))
    assert not masks[1].any()


def test_the_gripper_consists_of_regions_that_lie_wholly_in_the_circle() -> None:
    image = canvas((RED, slice(0, 8), slice(36, 44)), (BLUE, slice(30, 40), slice(36, 44)))
    regions = make_part("segmenter", "flat").propose([image])
    [chosen] = make_part("selector", "circle").select([image], regions)
    assert [bounding_box(regions[0][i]).tolist() for i in chosen] == [[36, 0, 44, 8]]
    [elsewhere] = make_part("selector", {"circle": {"point": [0.5, 0.6], "radius": 0.2}}).select(
        [image], regions
    )
    assert [bounding_box(regions[0][i]).tolist() for i in elsewhere] == [[36, 30, 44, 40]]


def test_a_segment_is_followed_past_others_of_its_colour() -> None:
    tracker = make_part("tracker", "iou")
    start = canvas((RED, slice(10, 20), slice(10, 20)), (RED, slice(10, 20), slice(40, 50)))
    [memory] = tracker.begin([start], [mask_at(slice(10, 20), slice(10, 20))[None]])
    for x in range(10, 25, 3):
        image = canvas((RED, slice(10, 20), slice(x, x + 10)), (RED, slice(10, 20), slice(40, 50)))
        [(masks, visible)] = tracker.follow([image], [memory])
        assert visible.all()
        assert bounding_box(masks[0]).tolist() == [x, 10, x + 10, 20]


def test_a_segment_that_is_covered_is_lost_and_seen_again_where_it_was() -> None:
    tracker = make_part("tracker", "iou")
    segment = mask_at(slice(10, 20), slice(10, 20))
    shown = canvas((RED, slice(10, 20), slice(10, 20)))
    covered = canvas((BLUE, slice(5, 25), slice(5, 25)))
    [memory] = tracker.begin([shown], [segment[None]])

    [(_, visible)] = tracker.follow([covered], [memory])
    assert not visible.any()
    [(masks, visible)] = tracker.follow([shown], [memory])
    assert visible.all()
    assert np.array_equal(masks[0], segment)


def test_a_grid_is_drawn_on_the_colour() -> None:
    mask = np.zeros((60, 80), bool)
    config = BackgroundConfig(colour=(9, 9, 9), grid=(50, 60, 70), spacing=0.5)
    drawn = Background(config).behind(canvas(), mask)
    assert {tuple(pixel) for pixel in drawn.reshape(-1, 3).tolist()} == {(9, 9, 9), (50, 60, 70)}
    assert drawn[15].tolist() == [[50, 60, 70]] * 80


def test_an_image_as_background_is_stretched_to_the_camera(tmp_path) -> None:
    from PIL import Image

    Image.new("RGB", (8, 6), BLUE).save(tmp_path / "sea.png")
    background = Background(BackgroundConfig(image=tmp_path / "sea.png"))
    background.load()
    mask = mask_at(slice(10, 20), slice(10, 20))
    drawn = background.behind(canvas(), mask)
    assert np.array_equal(drawn[mask], canvas()[mask])
    assert (drawn[~mask] == BLUE).all()


@pytest.mark.parametrize(
    ("kind", "entry", "message"),
    [
        ("detector", "yolo", "expected one of .*grounding_dino.*got 'yolo'"),
        ("detector", {"colour": {"hue": {}}}, "detector 'colour'.*hue"),
        ("tracker", {"iou": {}, "sam2": {}}, "expected one name"),
        ("selector", "nowhere.at.all:Selector", "no module 'nowhere'"),
    ],
)
def test_a_part_that_cannot_be_made_is_an_error(kind: str, entry: object, message: str) -> None:
    with pytest.raises(ConfigError, match=f"(?s){message}"):
        make_part(kind, entry)  # type: ignore[arg-type]
