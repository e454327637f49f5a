"""Tables of episodes: the same values in each format, and documented columns."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_fakes import OTHER_LINE
from exported_results import SETTINGS, with_a_lost_episode

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.envs.base import EvalEnv
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, Results, evaluate
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.exports import COLUMNS, rows, to_csv, to_json
from vlagents_ray.interface import Act, Agent, Obs

Config = Callable[..., EvalConfig]


@pytest.fixture
def results(config: Config) -> Results:
    return with_a_lost_episode(config(**SETTINGS))


def test_json_and_csv_hold_the_values_of_each_episode(results: Results, tmp_path: Path) -> None:
    assert to_json(results, tmp_path / "a.json") == to_csv(results, tmp_path / "a.csv") == 5
    with (tmp_path / "a.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    objects = json.loads((tmp_path / "a.json").read_text())
    for row, line, written in zip(rows(results), lines, objects, strict=True):
        for column in COLUMNS:
            value, text, plain = row[column.name], line[column.name], written[column.name]
            if column.type == "json":
                assert json.loads(text) == plain == json.loads(json.dumps(value))
            elif column.type == "time":
                assert text == plain == value.isoformat()
            elif value is None:
                assert (text, plain) == ("", None)
            else:
                assert plain == value
                assert text == (str(value).lower() if column.type == "boolean" else str(value))


@pytest.mark.parametrize("text", ["=HYPERLINK(1)", "+1", "-1", "@SUM(1)", "\t=1", "\r=1", "\n=1"])
def test_no_text_of_a_table_is_a_formula_of_a_spreadsheet(
    results: Results, tmp_path: Path, text: str
) -> None:
    [case, *others] = results.cases
    episodes = []
    for episode in case.episodes:
        result = dataclasses.replace(
            episode.result, instruction=text, error=text, ending=text, transport=text, weights=text
        )
        episodes.append(dataclasses.replace(episode, result=result, trajectory=text))
    foreign = dataclasses.replace(case, policy=text, suite=text, episodes=tuple(episodes))
    to_csv(results.among([foreign, *others]), tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            texts = [row[column.name] for column in COLUMNS if column.type in ("string", "json")]
            assert not [cell for cell in texts if cell.startswith(text[0])]
            if row["suite"] and row["status"] == "done":
                assert row["instruction"] == f"'{text}"


@pytest.mark.parametrize("write", [to_json, to_csv])
def test_a_table_is_a_file_in_a_folder_that_exists(
    results: Results, tmp_path: Path, write: Callable[[Results, Path], int]
) -> None:
    with pytest.raises(ConfigError, match="expected a file, got a folder"):
        write(results, tmp_path)
    with pytest.raises(ConfigError, match="expected a file in an existing folder"):
        write(results, tmp_path / "missing" / "a.csv")


def test_every_field_of_a_result_has_a_column() -> None:
    renamed = {"episode_return": "return"}
    fields = {renamed.get(one.name, one.name) for one in dataclasses.fields(EpisodeResult)}
    assert fields <= {column.name for column in COLUMNS}


def test_a_part_of_the_results_is_exported_alone(results: Results, tmp_path: Path) -> None:
    assert to_json(results.only(env=OTHER_LINE), tmp_path / "a.json") == 2


class Bare(EvalEnv):
    """An environment that provides only what its interface requires."""

    max_steps = 2

    @property
    def contract(self) -> Contract:
        return Contract(action=ActionSpec(dim=1))

    @property
    def instruction(self) -> str:
        return ""

    def reset(self, *, seed: int, options: Any = None) -> tuple[Obs, dict[str, Any]]:
        self.count = 0
        return Obs(), {}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        self.count += 1
        return Obs(), 0.5, False, self.count == 2, {"success": False}

    def close(self) -> None:
        pass


class Plain(Agent):
    """A policy that provides only what its interface requires."""

    def reset(self, obs: Obs, instruction: str | None = None, **options: Any) -> dict[str, Any]:
        return {}

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(1, np.float32))


# The columns of an episode of `Bare` and `Plain` that are not null: each is measured here, follows
# from the plan, or is required from every environment.
PLANNED = {"key", "policy", "suite", "env", "episode", "seed", "settings", "run", "attempts"}
MEASURED = {"seconds", "reset_ms", "env_step_ms", "env_seconds", "policy_ms", "policy_p95_ms"}
MEASURED |= {"policy_seconds", "acts", "ticks_waited", "finished", "actions_sha256", "start"}
REQUIRED = {"success_once", "success_at_end", "steps", "return", "ending"}
EMPTY: tuple[Any, ...] = (None, "", {}, [], ())
RECORDED = {"code", "status", "counted", "transport", "env_program", "policy_program"}


def test_what_an_environment_or_a_policy_does_not_provide_is_null(tmp_path: Path) -> None:
    config = EvalConfig.model_validate(
        {
            "policies": [{"name": "plain", "url": "http://x"}],
            "suites": [{"envs": [f"{__name__}:Bare"], "episodes": 1}],
            "out": tmp_path,
            "workers": 0,
        }
    )
    results = evaluate(config, agent_factory=Plain).results
    [row] = rows(results)
    present = {name for name, value in row.items() if value not in EMPTY}
    assert present <= PLANNED | MEASURED | REQUIRED | RECORDED
    assert (row["return"], row["success_once"], row["steps"]) == (1.0, False, 2)
    assert row["ticks_waited"] == 0


def test_a_lost_episode_has_no_measured_value(results: Results) -> None:
    [lost] = [row for row in rows(results) if row["status"] == "infra_failed"]
    present = {name for name, value in lost.items() if value not in EMPTY}
    described = {"described", "code", "env_program", "policy_program"}
    assert present <= PLANNED | described | {"status", "counted", "error", "finished"}
