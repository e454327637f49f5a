"""`eval` with policies that fail: the terminal shows the error, and the exit status says that there
is no result.
"""

from __future__ import annotations

import contextlib
import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_fakes import LINE, ToZero
from in_process_evaluation import flat_config
from typer.testing import CliRunner, Result

from vlagents_ray.cli import evaluate as command
from vlagents_ray.cli import evaluation as run
from vlagents_ray.cli.main import app
from vlagents_ray.cli.policies import Served
from vlagents_ray.contract import Contract
from vlagents_ray.envs import EvalEnv
from vlagents_ray.envs.base import SequentialBatch
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.episode.episode import run_episodes
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.overrides import parse_settings


class Failing(ToZero):
    """A policy that returns NaN or reads a missing key, in all episodes or in those of some
    seeds.
    """

    def __init__(self, how: str, seeds: tuple[int, ...] | None = None) -> None:
        super().__init__()
        self.how, self.seeds = how, seeds

    @property
    def contract(self) -> Contract | None:
        return None

    def act(self, obs: Obs) -> Any:
        if self.seeds is not None and self._seed not in self.seeds:
            return super().act(obs)
        if self.how == "key":
            return obs.cameras[f"masst{self._seed}"]
        return Act(np.full(1, np.nan, np.float32))


def eval_of(
    out: Path, agent: functools.partial[Agent], monkeypatch: pytest.MonkeyPatch, **settings: Any
) -> Result:
    """Run the command in this process."""
    config = flat_config(
        **{"envs": [LINE], "episodes": 4, "out": out, "video": "none", "workers": 0, **settings}
    )
    monkeypatch.setattr(command, "config_from_options", lambda *_: config)
    monkeypatch.setattr(
        run,
        "served",
        lambda *_, **__: contextlib.nullcontext(Served(resolve(config), {"policy": agent})),
    )
    return CliRunner().invoke(
        app, ["eval", LINE, "--policy", "http://127.0.0.1:9"], env={"COLUMNS": "300"}
    )


WORDS = {
    "nan": "action: expected finite numbers, got NaN or infinity; check the policy's output",
    "key": "policy act: KeyError: 'masst0'",
}


@pytest.mark.parametrize("how", WORDS)
def test_a_policy_that_always_fails_says_so_and_ends_with_a_status_of_its_own(
    how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = eval_of(tmp_path / "out", functools.partial(Failing, how), monkeypatch)
    assert done.exit_code == run.POLICY_ERRORS, done.output
    failed = [line for line in done.stdout.splitlines() if "counted as no success" in line]
    assert len(failed) == 1  # one message for each cause
    assert WORDS[how] in failed[0]
    [title] = [i for i, line in enumerate(done.stdout.splitlines()) if "Errors of policies" in line]
    [row] = [line for line in done.stdout.splitlines()[title:] if WORDS[how] in line]
    assert row.split()[-1] == "4"
    assert "every episode ended with an error of the policy" in done.stderr


def test_a_policy_that_fails_now_and_then_has_a_rate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = eval_of(tmp_path / "out", functools.partial(Failing, "nan", (1, 2)), monkeypatch)
    assert done.exit_code == 0, done.output
    assert "2 episodes ended with an error of the policy" in done.stdout


def test_errors_of_the_policy_in_a_row_stop_the_evaluation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent = functools.partial(Failing, "key")
    done = eval_of(tmp_path / "out", agent, monkeypatch, episodes=50, abort_after=3)
    assert done.exit_code == run.POLICY_ERRORS, done.output
    assert (
        "3 episodes in a row ended with an error of the policy: policy_failed: policy act: KeyError"
        in done.stderr
    )
    assert "3/50" in done.stdout


class Unstated(EvalEnv):
    """An environment that does not declare the size of its actions."""

    max_steps = 4
    contract = Contract()
    instruction = ""

    def reset(self, *, seed: int, options: Any = None) -> tuple[Obs, dict[str, Any]]:
        return Obs(), {}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        return Obs(), 0.0, False, False, {"success": True}

    def close(self) -> None:
        pass


class Shrinking(Agent):
    """A policy that returns five numbers at first, and later three."""

    acts = 0

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {}

    def act(self, obs: Obs) -> Act:
        self.acts += 1
        return Act(np.zeros(5 if self.acts < 3 else 3, np.float32))


def test_an_action_of_another_size_than_the_first_is_an_error_of_the_policy() -> None:
    agent = Shrinking()
    [result] = run_episodes(
        SequentialBatch([Unstated()]), agent, [agent], [EpisodeKey("a", 0, 0, "b")]
    )
    assert isinstance(result, EpisodeResult)
    assert (result.status, bool(result.success_at_end)) == ("policy_error", False)
    assert "expected 5 numbers in each row, as in the first action, got shape (1, 3)" in (
        result.error or ""
    )


@pytest.mark.parametrize("text", ["@handle", "%2", "`x`", "*all", "a: b: c", "!tag"])
def test_a_setting_that_is_not_yaml_is_text_but_not_an_unfinished_list_mapping_or_quotation(
    text: str,
) -> None:
    assert parse_settings([f"name={text}"], "--set") == {"name": text}
    for unfinished in ("[1, 2", "{a: 1", '"open'):
        with pytest.raises(ConfigError, match="not YAML"):
            parse_settings([f"name={unfinished}"], "--set")
