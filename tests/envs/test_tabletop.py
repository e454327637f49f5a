"""The built-in environment: its contract, its determinism, and the effect of its instructions."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from many import many

from vlagents_ray import Act
from vlagents_ray.envs import make_env
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.envs.tabletop.render import PALETTE
from vlagents_ray.errors import ConfigError, NotReset, UnknownEnv
from vlagents_ray.images.jpeg_png import decode, encode_jpeg
from vlagents_ray.interface import Obs
from vlagents_ray.policies.scripted import Scripted
from vlagents_ray.testing import check_env


def play(
    env: Tabletop, seed: int, *, wrong: bool = False, seen: Callable[[Obs], Obs] = lambda obs: obs
) -> bool:
    """Return whether the expert succeeds when it follows the episode's instruction, or another
    instruction of the same scene.
    """
    obs, info = env.reset(seed=seed)
    followed = env.instruction
    if wrong:
        others = [text for text in info["instructions"] if text != followed]
        followed = others[np.random.default_rng(seed).integers(len(others))]
    agent = Scripted()
    agent.reset(seen(obs), followed, env="tabletop", seed=seed)
    success = truncated = False
    while not truncated:
        act = agent.act(obs)
        obs, _, _, truncated, info = env.step(act)
        success = info["success"]
        if act.done:
            break
    return bool(success)


@pytest.mark.parametrize("task", Tabletop.tasks())
def test_every_task_keeps_the_contract(task: str) -> None:
    check_env(make_env(f"tabletop/{task}"), steps=20)


@pytest.mark.slow
@pytest.mark.parametrize("task", Tabletop.tasks())
def test_following_the_instruction_succeeds_and_another_one_does_not(task: str) -> None:
    env = Tabletop(task)
    right = [play(env, seed) for seed in range(many(100))]
    wrong = [play(env, seed, wrong=True) for seed in range(many(100))]
    assert np.mean(right) >= 0.95
    assert np.mean(wrong) <= 0.20


@pytest.mark.parametrize(("width", "height"), [(96, 96), (320, 240), (240, 320)])
def test_the_expert_sees_at_every_image_size(width: int, height: int) -> None:
    env = Tabletop(width=width, height=height)
    assert env.reset(seed=0)[0].cameras["front"].shape == (height, width, 3)
    assert np.mean([play(env, seed) for seed in range(many(20))]) >= 0.95


@pytest.mark.parametrize("subsampling", ["444", "420"])
def test_the_expert_sees_through_jpeg(subsampling: str) -> None:
    def seen(obs: Obs) -> Obs:
        return replace(
            obs, cameras={"front": decode(encode_jpeg(obs.cameras["front"], 85, subsampling))}
        )

    env = Tabletop()
    assert np.mean([play(env, seed, seen=seen) for seed in range(many(20))]) >= 0.95


def test_mixed_draws_every_task() -> None:
    env = Tabletop()
    verbs = set()
    for seed in range(40):
        env.reset(seed=seed)
        verbs.add(env.instruction.split()[0])
    assert verbs == {"put", "slide", "stack", "lift"}


def digest_of_episode(env: Tabletop, seed: int) -> str:
    obs, _ = env.reset(seed=seed)
    rng, digest = np.random.default_rng(0), hashlib.sha256(env.instruction.encode())
    for _ in range(20):
        obs, *_ = env.step(Act(rng.uniform(-1, 1, 4).astype(np.float32)))
        digest.update(obs.cameras["front"].tobytes() + obs.state["xyzrpy"].tobytes())
    return digest.hexdigest()


def test_an_episode_is_the_same_in_another_process_and_after_other_episodes() -> None:
    code = "from test_tabletop import *; print(digest_of_episode(Tabletop(), 11))"
    path = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    elsewhere = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": path},
    )
    env = Tabletop()
    other = digest_of_episode(env, 3)
    assert digest_of_episode(env, 11) == elsewhere.stdout.strip() != other


def test_a_chosen_instruction_leaves_the_scene_as_it_is() -> None:
    env = Tabletop("pick_place")
    before, info = env.reset(seed=5)
    other = next(text for text in info["instructions"] if text != env.instruction)
    after, _ = env.reset(seed=5, options={"instruction": other})
    assert env.instruction == other
    assert np.array_equal(before.cameras["front"], after.cameras["front"])


def test_the_wrist_camera_follows_the_gripper_and_shows_what_is_below_it_enlarged() -> None:
    env = Tabletop("lift", width=64, height=64, cameras=("front", "wrist"))
    seen, _ = env.reset(seed=2)
    expert = Scripted()
    expert.reset(seen, env.instruction, env="tabletop", seed=0)
    colour = np.array(PALETTE[env.instruction.split()[2]])
    first, last = seen.cameras["wrist"], seen
    while last.gripper == 1.0:  # until the fingers close around the puck
        last = env.step(expert.act(last))[0]
    assert first.shape == last.cameras["wrist"].shape == (64, 64, 3)

    def coloured(image: np.ndarray) -> np.ndarray:
        return np.abs(image.astype(int) - colour).sum(-1) < 60  # type: ignore[no-any-return]

    near, far = coloured(last.cameras["wrist"]), coloured(last.cameras["front"])
    assert near.sum() > 4 * far.sum() > 0 == coloured(first).sum()
    assert np.abs(np.argwhere(near).mean(0) - 32).max() < 8


def test_disturbances_follow_from_the_seed_and_the_expert_recovers() -> None:
    def path(disturbance: float) -> np.ndarray:
        env = Tabletop(width=64, height=64, disturbance=disturbance)
        env.reset(seed=1)
        return np.array(
            [env.step(Act(np.zeros(4, np.float32)))[0].state["xyzrpy"][:3] for _ in range(80)]
        )

    assert np.array_equal(path(1.0), path(1.0))
    moved = np.abs(np.diff(path(1.0), axis=0)).max(-1) > 0
    assert 2 <= moved.sum() <= 20
    assert not np.diff(path(0.0), axis=0).any()
    env = Tabletop("pick_place", disturbance=0.5)
    assert np.mean([play(env, seed) for seed in range(many(50))]) >= 0.8


@pytest.mark.parametrize("ends", [False, True])
def test_success_ends_an_episode_only_on_request(ends: bool) -> None:
    env = Tabletop("lift", max_steps=60, ends_on_success=ends)
    expert = Scripted.from_config({})
    obs, _ = env.reset(seed=1)
    expert.reset(obs, env.instruction, env="tabletop/lift")
    ended = []
    for _ in range(60):
        obs, _, terminated, truncated, info = env.step(expert.act(obs))
        ended.append((terminated, info["success"]))
        if terminated or truncated:
            break
    first = next(number for number, (_, success) in enumerate(ended) if success)
    assert [terminated for terminated, _ in ended].count(True) == ends
    assert (len(ended) == first + 1) == ends


def test_what_there_is_not_is_refused() -> None:
    elsewhere = "put the orange puck on the blue pad"
    for option, value in (("instruction", elsewhere), ("init_state", "3")):
        with pytest.raises(ConfigError, match=value if option == "instruction" else option):
            Tabletop().reset(seed=0, options={option: value})
    with pytest.raises(UnknownEnv, match="pick_place"):
        make_env("tabletop/juggle")
    with pytest.raises(NotReset):
        Tabletop().step(Act(np.zeros(4, np.float32)))
    for task, option, value, text in (
        ("lift", "width", 3, "at least 32"),
        ("lift", "pucks", 0, "1 to 4 in 'lift'"),
        ("lift", "pucks", 5, "1 to 4 in 'lift'"),
        (None, "pucks", 1, "2 to 4 in 'mixed'"),
        (None, "disturbance", 2.0, "0 to 1 in 'mixed'"),
    ):
        with pytest.raises(ConfigError, match=f"{option}: expected {text}, got {value}"):
            Tabletop(task, **{option: value})

    with pytest.raises(
        ConfigError, match=r"expected cameras of \['front', 'wrist'\], got \['top'\]"
    ):
        Tabletop(cameras=("top",))


@pytest.mark.parametrize("task", ["pick_place", "slide", "lift"])
def test_one_puck_is_the_only_one_that_is_named(task: str) -> None:
    env = Tabletop(task, pucks=1)
    _, info = env.reset(seed=0)
    assert (
        len({text.split(" puck ")[0] for text in [f"{text} " for text in info["instructions"]]})
        == 1
    )
    assert np.mean([play(env, seed) for seed in range(many(20))]) >= 0.95


@pytest.mark.parametrize("task", ["pick_place", "slide", "stack", "lift"])
def test_the_state_of_the_objects_says_where_the_puck_is_and_where_it_is_to_be(task: str) -> None:
    env = Tabletop(task, object_state=True)
    check_env(env, steps=20)
    seen, _ = env.reset(seed=0)
    plain = Tabletop(task).reset(seed=0)[0]
    assert {"puck", "target"} == set(seen.state) - set(plain.state)
    np.testing.assert_array_equal(seen.cameras["front"], plain.cameras["front"])
    expert = Scripted()
    expert.reset(seen, env.instruction, env="tabletop", seed=0)
    off = [np.linalg.norm(seen.state["puck"] - seen.state["target"])]
    success = False
    while not success:
        seen, _, _, truncated, info = env.step(expert.act(seen))
        assert not truncated
        success = info["success"]
        off.append(np.linalg.norm(seen.state["puck"] - seen.state["target"]))
    assert off[0] > 0.07
    assert off[-1] < 0.06, (
        "the puck must be within the pad, on the other puck, or slightly above the required height"
    )


def test_a_full_action_moves_three_centimetres_and_more_is_clipped() -> None:
    env = Tabletop()
    start, _ = env.reset(seed=0)
    obs, *_ = env.step(Act(np.array([1.0, -5.0, 0.0, 1.0], np.float32)))
    moved = obs.state["xyzrpy"][:3] - start.state["xyzrpy"][:3]
    np.testing.assert_allclose(moved, [0.03, -0.03, 0.0], atol=1e-6)


def test_the_gripper_reports_one_when_open_and_zero_when_closed() -> None:
    env = Tabletop()
    start, _ = env.reset(seed=0)
    for _ in range(3):
        closed, *_ = env.step(Act(np.array([0, 0, 0, -1], np.float32)))
    assert (start.gripper, closed.gripper) == (1.0, pytest.approx(0.0, abs=1e-9))


def test_the_image_shows_the_gripper_where_the_calibration_says() -> None:
    env = Tabletop()
    still, _ = env.reset(seed=0)
    moved, *_ = env.step(Act(np.array([-1, 0, 0, 1], np.float32)))
    changed = np.any(still.cameras["front"] != moved.cameras["front"], axis=2)
    rows, columns = np.nonzero(changed)
    x, y, z = moved.state["xyzrpy"][:3]
    scale = 224 / 0.66
    u, v = 112 + scale * x, 112 - scale * (y * np.sin(np.radians(70)) + z * np.cos(np.radians(70)))
    assert columns.min() < u < columns.max()
    assert rows.min() < v < rows.max()
