"""The motion of pucks and gripper, without any rendering."""

from __future__ import annotations

import math

import pytest

from vlagents_ray.envs.tabletop.world import (
    PUCK_HEIGHT,
    PUCK_RADIUS,
    STEP_LIMIT,
    Goal,
    Pad,
    Puck,
    TabletopWorld,
)

OPEN, CLOSED = 1.0, 0.0


def world(*pucks: Puck, pad: Pad | None = None) -> TabletopWorld:
    return TabletopWorld(list(pucks), [pad or Pad("blue", 0.2, 0.0)])


def go(scene: TabletopWorld, x: float, y: float, z: float, opening: float) -> None:
    """Move straight to (x, y, z) and stop there, as far as the world allows the gripper to move."""
    for _ in range(40):
        offset = (x - scene.x, y - scene.y, z - scene.z)
        slow = max(1.0, max(map(abs, offset)) / STEP_LIMIT)
        scene.step(*(d / slow for d in offset), opening)


def grasp(scene: TabletopWorld, puck: Puck) -> None:
    go(scene, puck.x, puck.y, 0.1, OPEN)
    go(scene, puck.x, puck.y, puck.z + 0.005, OPEN)
    go(scene, puck.x, puck.y, puck.z + 0.005, CLOSED)


def test_closing_around_a_puck_holds_it_and_it_follows() -> None:
    red = Puck("red", 0.05, 0.02)
    scene = world(red)
    grasp(scene, red)
    assert scene.held_puck is red
    go(scene, -0.1, 0.1, 0.12, CLOSED)
    assert (red.x, red.y) == pytest.approx((-0.1, 0.1), abs=1e-3)
    assert red.z == pytest.approx(0.115, abs=1e-3)
    assert red.lifted


def test_a_puck_released_over_another_stands_on_it_and_falls_when_that_is_taken_away() -> None:
    red, blue = Puck("red", 0.0, 0.0), Puck("blue", 0.15, 0.0)
    scene = world(red, blue)
    grasp(scene, red)
    go(scene, 0.0, 0.0, 0.1, CLOSED)
    go(scene, 0.15, 0.0, 0.1, CLOSED)
    go(scene, 0.15, 0.0, 0.1, OPEN)
    assert red.z == pytest.approx(PUCK_HEIGHT)
    assert Goal("stack", "red", "blue").is_reached(scene)
    assert not Goal("stack", "blue", "red").is_reached(scene)
    blue.x = -0.2
    scene.step(0, 0, 0, OPEN)
    assert red.z == 0.0


def test_what_stands_on_the_held_puck_is_carried_with_it() -> None:
    below, above = Puck("red", 0.0, 0.0), Puck("blue", 0.0, 0.0, PUCK_HEIGHT)
    scene = world(below, above)
    scene.x, scene.y, scene.z = 0.0, 0.0, 0.005
    for _ in range(3):
        scene.step(0, 0, 0, CLOSED)
    assert scene.held_puck is below
    go(scene, 0.1, 0.05, 0.05, CLOSED)
    assert (above.x, above.y) == pytest.approx((below.x, below.y), abs=1e-6)
    assert above.z == pytest.approx(below.z + PUCK_HEIGHT)


def test_a_pushed_puck_pushes_the_next_and_they_never_overlap() -> None:
    red, blue = Puck("red", 0.0, 0.0), Puck("blue", 0.0, -0.06)
    scene = world(red, blue)
    go(scene, 0.0, 0.1, 0.1, CLOSED)
    go(scene, 0.0, 0.1, 0.005, CLOSED)
    go(scene, 0.0, -0.05, 0.005, CLOSED)
    assert blue.y < -0.1
    assert math.hypot(red.x - blue.x, red.y - blue.y) >= 2 * PUCK_RADIUS - 1e-5


def test_a_closed_gripper_comes_to_rest_on_top_of_a_puck() -> None:
    red = Puck("red", 0.0, 0.0)
    scene = world(red)
    go(scene, 0.0, 0.0, 0.1, CLOSED)
    go(scene, 0.0, 0.0, 0.0, CLOSED)
    assert scene.z == pytest.approx(PUCK_HEIGHT)
    assert (red.x, red.y, red.z) == (0.0, 0.0, 0.0)


def test_a_held_puck_cannot_be_pressed_into_the_table() -> None:
    red = Puck("red", 0.0, 0.0)
    scene = world(red)
    grasp(scene, red)
    go(scene, 0.0, 0.0, 0.1, CLOSED)
    go(scene, 0.0, 0.0, 0.0, CLOSED)
    assert red.z == pytest.approx(0.0, abs=1e-9)


def test_pucks_stay_on_the_table() -> None:
    red = Puck("red", 0.25, 0.0)
    scene = world(red)
    go(scene, 0.15, 0.0, 0.1, CLOSED)
    go(scene, 0.15, 0.0, 0.005, CLOSED)
    go(scene, 0.30, 0.0, 0.005, CLOSED)
    assert abs(red.x) <= 0.30 - PUCK_RADIUS + 1e-9


def test_only_the_named_puck_on_the_named_pad_counts() -> None:
    scene = TabletopWorld(
        [Puck("red", 0.2, 0.0), Puck("green", 0.0, 0.0)],
        [Pad("blue", 0.2, 0.0), Pad("red", -0.2, 0.0)],
    )
    reached = {
        (puck, pad): Goal("pick_place", puck, pad).is_reached(scene)
        for puck in ("red", "green")
        for pad in ("blue", "red")
    }
    assert [pair for pair, there in reached.items() if there] == [("red", "blue")]


def test_a_slide_does_not_count_once_the_puck_was_lifted() -> None:
    red = Puck("red", 0.2, 0.0)
    scene = world(red)
    assert Goal("slide", "red", "blue").is_reached(scene)
    red.lifted = True
    assert not Goal("slide", "red", "blue").is_reached(scene)
    assert Goal("pick_place", "red", "blue").is_reached(scene)


def test_a_puck_still_held_over_its_pad_does_not_count() -> None:
    red = Puck("red", 0.2, 0.0)
    scene = world(red)
    grasp(scene, red)
    assert scene.held_puck is red
    assert not Goal("pick_place", "red", "blue").is_reached(scene)


def test_lift_counts_while_the_puck_is_held_high() -> None:
    red, blue = Puck("red", 0.0, 0.0), Puck("blue", 0.15, 0.0)
    scene = world(red, blue)
    grasp(scene, red)
    assert not Goal("lift", "red").is_reached(scene)
    go(scene, 0.0, 0.0, 0.12, CLOSED)
    assert Goal("lift", "red").is_reached(scene)
    assert not Goal("lift", "blue").is_reached(scene)
