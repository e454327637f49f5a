"""An episode is rendered in a second pass by repeating its actions, and only if the second pass is
identical.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from eval_fakes import Line

from vlagents_ray.envs import EvalEnv
from vlagents_ray.envs.base import SequentialBatch
from vlagents_ray.evaluate.episode.second_pass import PlayedEpisode
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.interface import Act, Obs

STEPS = 4


class Altered(Line):
    """An environment in which something differs from `Line` after two steps."""

    def __init__(self, what: str | None = None) -> None:
        super().__init__(camera=(4, 4))
        self._what = what

    def step(self, act: Act) -> Any:
        obs, reward, terminated, truncated, info = super().step(act)
        if self._steps != 2:
            return obs, reward, terminated, truncated, info
        if self._what == "raises":
            raise RuntimeError("this episode is over")
        if self._what == "image":
            obs = replace(obs, cameras={"front": obs.cameras["front"] ^ 1})
        if self._what == "state":
            obs = replace(
                obs, state={"position": np.nextafter(obs.state["position"], np.float32(100))}
            )
        if self._what == "gripper":
            obs = replace(obs, gripper=0.5)
        if self._what == "success":
            info = {"success": True}
        return (
            obs,
            np.nextafter(reward, 0.0) if self._what == "reward" else reward,
            terminated,
            truncated,
            info,
        )


def once(env: EvalEnv, left_out: int | None = None) -> PlayedEpisode:
    """Return an episode of some steps, one of which is not rendered."""
    played = PlayedEpisode()
    played.add_observation(env.reset(seed=3)[0])
    for number in range(1, STEPS + 1):
        action = np.array([-0.1 * number], np.float32)
        obs, reward, *_, info = env.step(Act(action))
        played.add_observation(replace(obs, cameras={}) if number == left_out else obs)
        played.add_action(action, reward, info["success"])
    return played


def again(played: PlayedEpisode, env: EvalEnv) -> tuple[str | None, list[Obs]]:
    shown: list[Obs] = []
    key, batch = EpisodeKey("line", 0, 3, "0"), SequentialBatch([env])
    return played.play_again(batch, key, None, lambda *_: None, shown.append), shown


def test_the_same_episode_is_shown_wholly() -> None:
    played = once(Altered(), left_out=2)
    difference, shown = again(played, Altered())
    assert difference is None
    assert [obs.cameras["front"][0, 0, 0] for obs in shown] == [0, 20, 40, 60, 80]


@pytest.mark.parametrize(
    ("what", "named"),
    [
        ("state", "after 2 steps, state 'position' differs"),
        ("gripper", "after 2 steps, the gripper differs"),
        ("reward", "after 2 steps, reward or success differs"),
        ("success", "after 2 steps, reward or success differs"),
        ("image", "after 2 steps, image 'front' differs"),
        ("raises", "this episode is over"),
    ],
)
def test_what_is_not_the_same_to_the_bit_ends_it(what: str, named: str) -> None:
    difference, shown = again(once(Altered()), Altered(what))
    assert difference is not None
    assert named in difference
    assert len(shown) <= 3


def test_a_difference_after_the_last_step_is_found() -> None:
    played = once(Line())
    env = Line()
    played.add_observation(env.reset(seed=4)[0])
    played.add_action(np.zeros(1, np.float32), 0.0, False)
    difference, _ = again(played, Line())
    assert difference == "after the last step, reward or success differs"


def test_images_are_lacking_where_the_first_observation_has_them() -> None:
    assert not once(Line(camera=(4, 4))).lacks_images
    assert once(Line(camera=(4, 4)), left_out=4).lacks_images
    assert not once(Line()).lacks_images
