"""Suites that vary LIBERO's by other files alone, made here from LIBERO's own."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from libero_episodes import STILL, world

from vlagents_ray.envs.libero import Libero
from vlagents_ray.envs.libero.package import package_folder
from vlagents_ray.envs.libero.tasks import SUITES, find_task, read_states, require_suite, task_names
from vlagents_ray.errors import ConfigError, EnvFailed, MalformedMessage, UnknownEnv

MILK = "pick_up_the_milk_and_place_it_in_the_basket"


def put(folder: Path, suite: str, name: str, changes: dict[str, str], states: np.ndarray | None) -> None:
    """Write a task: that of the milk with other words in its BDDL file, and its initial states."""
    problem = (package_folder() / "bddl_files" / "libero_object" / f"{MILK}.bddl").read_text()
    for old, new in changes.items():
        assert old in problem
        problem = problem.replace(old, new)
    for part, file in (("bddl_files", f"{name}.bddl"), ("init_files", f"{name}.pruned_init")):
        (folder / part / suite).mkdir(parents=True, exist_ok=True)
        path = folder / part / suite / file
        if part == "bddl_files":
            path.write_text(problem)
        elif states is not None:
            torch.save(states, path, pickle_protocol=4)  # as LIBERO-PRO's are written


@pytest.fixture(scope="module")
def states() -> np.ndarray:
    return read_states(find_task(f"libero_object/{MILK}").states)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, states: np.ndarray) -> Path:
    """A folder of variants as LIBERO-PRO's, with another goal, and LIBERO-Plus's, with another instruction."""
    folder = tmp_path_factory.mktemp("variants")
    other = {"(:language Pick the milk and": "(:language Take the cream cheese and", "(In milk_1": "(In cream_cheese_1"}
    put(folder, "libero_object_task", MILK, other, states[:3])
    put(folder, "libero_object", f"{MILK}_language_2", {"Pick the milk": "Grasp the dairy"}, None)
    put(folder, "libero_object", MILK, {}, states)
    put(folder, "libero_object", f"{MILK}_level1_sample1", {}, None)
    put(folder, "libero_object", f"{MILK}_add_1", {"milk_1 - milk": "milk_1 - bag_of_yeast"}, None)
    put(folder, "libero_object", f"{MILK}_light_1", {"LIBERO_Floor_Manipulation": "LIBERO_Dim_Light"}, None)
    single = folder / "init_files" / "libero_newobj" / "libero_object"
    single.mkdir(parents=True)
    torch.save(states[4], single / f"{MILK}_level1_sample1.pruned_init", pickle_protocol=4)
    return folder


@pytest.mark.assets("libero")
def test_a_variant_is_played_by_the_protocol_of_the_suite_that_it_varies(folder: str, files: Path) -> None:
    with Libero("libero_object_task/0", width=16, height=16, assets=folder, files=str(files)) as env:
        env.reset(seed=0, options={"init_state": 2})
        assert env.step(STILL)[4] == {"success": False}
        assert env.instruction == "take the cream cheese and place it in the basket"
        assert world(env).goal == [["in", "cream_cheese_1", "basket_1_contain_region"]]
        facts = env.describe()
        assert (facts["task"], facts["init_states"], env.max_steps) == ("libero_object_task/0", 3, 280)
        assert facts["protocol"]["deviations"] == ["image_size: (16, 16), the protocol says (256, 256)"]
        assert len(facts["files"]) == 16


def test_a_suite_with_liberos_own_names_has_liberos_numbers(tmp_path: Path, states: np.ndarray) -> None:
    for number in range(10):
        put(tmp_path, "libero_object_lan", find_task(f"libero_object/{number}").name, {}, states)
    assert find_task("libero_object_lan/7", str(tmp_path)).name == MILK == find_task("libero_object/7").name
    put(tmp_path, "libero_object_lan", "a_further_task", {}, states)
    assert find_task("libero_object_lan/0", str(tmp_path)).name == "a_further_task"


def test_the_tasks_of_the_named_folder_are_listed(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LIBERO_FILES", str(files))
    assert task_names()[130:] == ["libero_object_task/0"]
    assert find_task("libero_object_task/0").varied
    assert not find_task("libero_object/0").varied


def test_initial_states_of_another_instruction_or_other_positions_are_found(files: Path, states: np.ndarray) -> None:
    spoken = find_task(f"libero_object/{MILK}_language_2", str(files))
    assert (spoken.full_name, spoken.passes_for_own) == (f"libero_object/{MILK}_language_2", True)
    assert not find_task("libero_object_task/0", str(files)).passes_for_own
    assert spoken.language == "grasp the dairy and place it in the basket"
    np.testing.assert_array_equal(read_states(spoken.states), states)
    moved = find_task(f"libero_object/{MILK}_level1_sample1", str(files))
    np.testing.assert_array_equal(read_states(moved.states), states[4:5])


@pytest.mark.parametrize(
    ("task", "error", "message"),
    [
        ("libero_object_swap/0", UnknownEnv, r"no suite 'libero_object_swap'.*libero_object_task"),
        ("libero_object_task/1", UnknownEnv, f"no task '1': want 0 to 0, or a name such as '{MILK}'"),
        (f"libero_object/{MILK}_add_1", ConfigError, r"wants \['bag_of_yeast'\].*code of LIBERO-PRO or LIBERO-Plus"),
        (f"libero_object/{MILK}_light_1", ConfigError, r"wants \['libero_dim_light'\]"),
    ],
)
def test_what_cannot_be_played_is_named(files: Path, task: str, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        find_task(task, str(files))


def test_files_that_are_missing_or_broken_are_named(tmp_path: Path, states: np.ndarray) -> None:
    with pytest.raises(ConfigError, match=r"want their files; .*hf download zhouxueyang/LIBERO-Pro.*LIBERO_FILES"):
        find_task("libero_goal_swap/0")
    with pytest.raises(ConfigError, match=r"lacks \['bddl_files', 'init_files'\]"):
        find_task("libero_goal_swap/0", str(tmp_path))
    put(tmp_path, "libero_object_swap", MILK, {}, None)
    with pytest.raises(ConfigError, match=rf"no initial states: looked for .*{MILK}.pruned_init"):
        find_task("libero_object_swap/0", str(tmp_path))
    put(tmp_path, "libero_object_swap", MILK, {"(define": "define"}, states)
    with pytest.raises(EnvFailed, match=r"failed to read .*parenthesis"):
        find_task("libero_object_swap/0", str(tmp_path))


def test_the_suite_that_is_varied_is_one_of_the_five() -> None:
    assert require_suite("libero_goal_swap/3") == ("libero_goal_swap", "3")
    for unknown in ("libero_swap/3", "goal_swap/3", "libero_goalswap/3"):
        with pytest.raises(UnknownEnv, match=min(SUITES)):
            require_suite(unknown)
    with pytest.raises(UnknownEnv, match="want a number, or a name"):
        require_suite("libero_goal_swap/")


def test_states_of_a_later_protocol_that_would_run_code_do_not(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[object, tuple[Path]]:
            return Path.touch, (tmp_path / "ran",)

    torch.save(Trap(), tmp_path / "states", pickle_protocol=4)
    with pytest.raises((MalformedMessage, pickle.UnpicklingError)):
        read_states(tmp_path / "states")
    assert not (tmp_path / "ran").exists()
