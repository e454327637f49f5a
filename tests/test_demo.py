"""The recorded session of the docs: its data match the policy's actions, and its page
replays them.
"""

from __future__ import annotations

import json
import runpy
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Page, browser
from eval_fakes import wait_for

from vlagents_ray import Act, Agent, Obs

FOLDER = Path(__file__).parents[1] / "docs/demo"
RECORDER = runpy.run_path(str(FOLDER / "record.py"))
SESSION: dict[str, Any] = RECORDER["recorded"]()
EPISODES: list[dict[str, Any]] = SESSION["episodes"]
play: Callable[[Agent, str, int], dict[str, Any]] = RECORDER["play"]


class Recorded(Agent):
    """A policy that returns the chunks of a recorded episode again, with their timings."""

    def __init__(self, episode: dict[str, Any]) -> None:
        self._acts = iter(episode["acts"])

    def act(self, obs: Obs) -> Act:
        act = next(self._acts)
        times = dict(zip(SESSION["stages"], act["ms"], strict=True)) | {
            "round_trip_ms": act["round_trip_ms"]
        }
        return Act(np.array(act["rows"], np.float32), info={"timing": times})


def test_four_seeds_of_three_tasks_are_recorded_and_some_fail() -> None:
    seeds: dict[str, list[int]] = {}
    for episode in EPISODES:
        seeds.setdefault(episode["task"], []).append(episode["seed"])
    assert seeds == {
        "pick_place": [12, 13, 14, 15],
        "slide": [0, 1, 2, 3],
        "stack": [16, 17, 18, 19],
    }
    assert {one["solved"] for one in EPISODES} == {True, False}
    assert {len(act["rows"]) for one in EPISODES for act in one["acts"]} == {8}
    assert all(
        0 < sum(act["ms"]) <= act["round_trip_ms"] + 0.01 for one in EPISODES for act in one["acts"]
    )
    assert sum(file.stat().st_size for file in FOLDER.iterdir() if file.is_file()) < 1e6


@pytest.mark.parametrize("episode", EPISODES, ids=lambda one: f"{one['task']}-{one['seed']}")
def test_the_recorded_chunks_lead_to_the_recorded_states(episode: dict[str, Any]) -> None:
    assert play(Recorded(episode), episode["task"], episode["seed"]) == episode


def test_sizes_and_colours_are_those_of_the_tabletop() -> None:
    now = {"geometry": RECORDER["geometry"](), "palette": RECORDER["render"].PALETTE}
    assert {name: SESSION[name] for name in now} == json.loads(json.dumps(now))


@pytest.mark.torch
def test_the_policy_plays_an_episode_again() -> None:
    from vlagents_ray.policies.reference import Reference

    episode = EPISODES[0]
    agent = Reference.from_config(RECORDER["POLICY"])
    agent.initialize()
    again = play(agent, episode["task"], episode["seed"])
    assert again["solved"] == episode["solved"]
    # Bit-identical on the recording's kind of processor; other processors sum in another order,
    # which rounds differently.
    np.testing.assert_allclose(again["states"], episode["states"], atol=1e-3)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


def step(page: Page) -> int:
    """Return the step that the page shows."""
    return int(page.value("document.getElementById('scrub').value"))


@pytest.mark.browser
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (1280, "dark"), (360, "light")])
def test_the_page_plays_a_session_from_a_file_and_fits(page: Page, width: int, scheme: str) -> None:
    page.said.clear()
    page.asked.clear()
    page.open(FOLDER / "index.html", width=width, scheme=scheme)
    wait_for(lambda: step(page) > 2)
    solved = next(i for i, one in enumerate(EPISODES) if one["solved"])
    for number, word in (
        (solved, "solved in"),
        (next(i for i, one in enumerate(EPISODES) if not one["solved"]), "not"),
    ):
        page.value(f"document.querySelectorAll('#episodes button')[{number}].click()")
        assert page.value("document.getElementById('outcome').textContent").startswith(word)
        assert (
            page.value("document.getElementById('instruction').textContent")
            == EPISODES[number]["instruction"]
        )
    assert page.value("document.documentElement.scrollWidth") <= width
    assert [url for url in page.asked if not url.startswith((FOLDER.as_uri(), "data:"))] == []
    assert page.said == []


@pytest.mark.browser
def test_the_page_is_played_by_the_keyboard(page: Page) -> None:
    page.open(FOLDER / "index.html", width=1280, scheme="light")
    wait_for(lambda: step(page) > 0)
    press(page, "play", " ")
    assert page.value("document.getElementById('play').textContent") == "Play"
    before = step(page)
    press(page, "scrub", "ArrowRight")
    assert step(page) == before + 1
    press(page, "scrub", "End")
    last = len(EPISODES[0]["states"]) - 1
    assert page.value("document.getElementById('step').textContent") == f"step {last} of {last}"
    assert page.value("document.getElementById('play').textContent") == "Again"


@pytest.mark.browser
def test_pucks_are_drawn_where_they_were_recorded(page: Page) -> None:
    page.open(FOLDER / "index.html", width=1280, scheme="light")
    # The pucks of this episode are far from each other and from the gripper, which would cover them.
    uncovered = next(i for i, one in enumerate(EPISODES) if one["task"] == "slide")
    page.value(f"choose({uncovered}); play(false)")
    colours = page.value("""episode.pucks.map((name, i) => {
        const [u, v] = pixel(...episode.states[0].slice(3 * i + 5, 3 * i + 7), PUCK_HEIGHT);
        return [palette[name], [...pen.getImageData(u, v, 1, 1).data.slice(0, 3)]];
    })""")
    for want, got in colours:
        np.testing.assert_allclose(got, 0.94 * np.array(want), atol=3)


def press(page: Page, element: str, key: str) -> None:
    """Press a key in an element."""
    page.value(f"document.getElementById({element!r}).focus()")
    text = {"text": key} if key == " " else {}
    codes = {" ": 32, "ArrowRight": 39, "End": 35}
    for event in ("keyDown", "keyUp"):
        typed = text if event == "keyDown" else {}
        page.call(
            "Input.dispatchKeyEvent", type=event, key=key, windowsVirtualKeyCode=codes[key], **typed
        )
