"""LIBERO's environment keeps its promises and the protocol's, with what is read from LIBERO's files."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from libero_episodes import STILL, begin, fingerprint, play
from unseen_images import require_same_without_unseen_images

from vlagents_ray.contract import CameraSpec
from vlagents_ray.envs.base import known_contract
from vlagents_ray.envs.libero import SUITES, Libero, axis_angle, find_task, read_states
from vlagents_ray.errors import UnknownEnv
from vlagents_ray.testing import check_env

pytestmark = pytest.mark.assets("libero")


@pytest.mark.slow
def test_it_keeps_the_promises_of_an_env(folder: str) -> None:
    check_env(Libero("libero_object/1", width=32, height=32, max_steps=4, assets=folder), steps=3)


def test_an_initial_state_gives_one_episode_whatever_was_played_and_whatever_the_seed(soup: Libero) -> None:
    first = fingerprint(play(soup, state=5))
    play(soup, state=6)
    begin(soup, state=5, seed=1234)
    assert fingerprint(play(soup, state=5)) == first
    assert fingerprint(play(soup, state=6)) != first


def test_two_envs_of_one_process_do_not_disturb_each_other(bowl: Libero, soup: Libero) -> None:
    alone = fingerprint(play(bowl))
    begin(soup)
    assert fingerprint(play(bowl, between=lambda: soup.step(STILL))) == alone
    begin(bowl)
    begin(soup)
    assert fingerprint(play(bowl)) == alone


def test_doing_nothing_solves_no_task_and_ends_at_the_limit(soup: Libero, monkeypatch: pytest.MonkeyPatch) -> None:
    assert soup.max_steps == 280
    monkeypatch.setattr(soup, "max_steps", 20)
    begin(soup)
    ended = [soup.step(STILL)[1:] for _ in range(20)]
    assert {(reward, terminated, info["success"]) for reward, terminated, _, info in ended} == {(0.0, False, False)}
    assert [truncated for _, _, truncated, _ in ended] == [False] * 19 + [True]


_CHILD = """
import sys
from libero_episodes import Libero, fingerprint, play
with Libero("libero_object/0", width=32, height=32, assets=sys.argv[1]) as env:
    print(fingerprint(play(env, 2)))
"""


@pytest.mark.slow
def test_another_process_plays_the_same_episode_and_leaves_the_home_alone(
    soup: Libero, folder: str, tmp_path: Path
) -> None:
    """In a process such as Ray's without a GPU, and a home in which nobody has used LIBERO yet."""
    package, support = Path(__file__).parents[3], Path(__file__).parents[2] / "support"
    variables = {"HOME": str(tmp_path), "PYTHONHASHSEED": "5", "CUDA_VISIBLE_DEVICES": ""}
    child = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", _CHILD, folder],
        env={**os.environ, **variables, "PYTHONPATH": f"{package}{os.pathsep}{support}"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )
    assert child.returncode == 0, child.stderr
    assert child.stdout.split()[-1] == fingerprint(play(soup, 2))
    assert not (tmp_path / ".libero").exists()


def test_tasks_go_by_number_and_by_name() -> None:
    by_number = find_task("libero_object/7")
    assert find_task(f"libero_object/{by_number.name}") == by_number
    assert by_number.language == by_number.name.replace("_", " ")
    assert find_task("libero_90/0").language == "close the top drawer of the cabinet"  # without "KITCHEN_SCENE10"
    for suite, known in SUITES.items():
        with pytest.raises(UnknownEnv, match=f"{known.tasks}.*want 0 to {known.tasks - 1}"):
            find_task(f"{suite}/{known.tasks}")


def test_a_description_states_task_versions_and_protocol(bowl: Libero) -> None:
    facts = bowl.describe()
    assert facts["task"] == "libero_spatial/0"
    assert facts["name"] == facts["language"].replace(" ", "_")
    assert bowl.instruction == facts["language"]
    assert (facts["hf-libero"], facts["robosuite"], facts["render_backend"]) == ("0.1.4", "1.4.0", "egl")
    assert facts["protocol"]["deviations"] == ["image_size: (64, 64), the protocol says (256, 256)"]
    assert facts["protocol"]["max_steps"] == bowl.max_steps == 220
    assert bowl.contract.cameras == {"front": CameraSpec(64, 64), "wrist": CameraSpec(64, 64)}
    assert bowl.contract == known_contract("libero/libero_spatial/0", {"width": 64, "height": 64})


def test_images_that_nobody_looks_at_are_not_rendered_and_change_nothing(
    soup: Libero, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(soup, "max_steps", 9)
    require_same_without_unseen_images(soup)


@pytest.mark.parametrize("suite", ["libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90"])
def test_each_suite_has_fifty_initial_states_a_task(suite: str) -> None:
    states = read_states(find_task(f"{suite}/3").states)
    assert states.shape[0] == 50
    assert states.dtype == np.float64
    assert np.isfinite(states).all()


def test_a_file_of_states_that_would_run_code_does_not(tmp_path: Path) -> None:
    import torch

    class Trap:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return Path.touch, (tmp_path / "ran",)  # type: ignore[return-value]

    torch.save(Trap(), tmp_path / "states")
    with pytest.raises(pickle.UnpicklingError, match="Weights only"):
        read_states(tmp_path / "states")
    assert not (tmp_path / "ran").exists()


def test_axis_angles_are_robosuites_for_both_signs_of_a_quaternion() -> None:
    find_task("libero_spatial/0")  # imports it
    from robosuite.utils.transform_utils import quat2axisangle

    drawn = np.random.default_rng(0).normal(size=(20, 4))
    for quaternion in drawn / np.linalg.norm(drawn, axis=1, keepdims=True):
        for signed in (quaternion, -quaternion):
            np.testing.assert_allclose(axis_angle(signed), quat2axisangle(signed.copy()), atol=1e-12)
    np.testing.assert_array_equal(axis_angle(np.array([0.0, 0.0, 0.0, 1.0])), np.zeros(3))
