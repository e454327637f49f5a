"""`--dry-run`: what an evaluation would take."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from eval_fakes import LINE, OTHER_LINE, ToZero

from vlagents_ray.cli.evaluation import print_plan
from vlagents_ray.evaluate import EvalConfig, Results, evaluate
from vlagents_ray.evaluate.estimate import forecasts, longest_episode
from vlagents_ray.evaluate.plan.cases import cells

Config = Callable[..., EvalConfig]


def test_the_longest_episode_has_as_many_steps_as_the_env_allows() -> None:
    def found(steps: int) -> float:  # the best of some, as a busy machine may be long at a reset
        tries = [longest_episode("tabletop", {"max_steps": steps}, {}) for _ in range(3)]
        return min(seconds for seconds in tries if isinstance(seconds, float))

    assert found(20_000) > 20 * found(20)


def test_why_an_env_cannot_be_timed_is_told() -> None:
    assert "the simulator is gone" in str(longest_episode(LINE, {"broken": "the simulator is gone"}, {}))


@pytest.mark.usefixtures("shared_ray")
class TestOnACluster:
    def test_an_env_is_timed_where_nothing_was_played(self, config: Config) -> None:
        settings = config(envs=[LINE, OTHER_LINE], episodes=4, seeds=[0, 10])
        for found in forecasts(settings, cells(settings), None):
            assert (found.finished, found.left, found.basis) == (0, 8, "measured")
            assert found.seconds is not None
            assert found.seconds > 0
        assert not settings.out.exists(), "nothing is written"

    def test_what_was_played_is_not_planned_again_and_tells_the_time(self, config: Config) -> None:
        settings = config(episodes=3)
        evaluate(settings, agent_factory=ToZero)
        results = Results.load(settings.out)
        [found] = forecasts(config(episodes=9), cells(config(episodes=9)), results)
        assert (found.finished, found.left, found.basis) == (3, 6, "results")
        seconds = [episode.seconds for episode in results.cells[0].counted]
        assert found.seconds == pytest.approx(sum(seconds) / 3)

    def test_nothing_is_left_of_a_cell_that_stopped(self, config: Config) -> None:
        settings = config(episodes=30, stop={"target": 0.3}, workers=1)  # of two, one may play all before the other one
        evaluate(settings, agent_factory=ToZero)
        [found] = forecasts(settings, cells(settings), Results.load(settings.out))
        assert found.finished < 30
        assert found.left == 0

    def test_the_plan_is_printed_without_asking_any_policy(
        self, config: Config, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("COLUMNS", "150")
        print_plan(config(episodes=5, policy_url="http://127.0.0.1:9", steps=[10, 20], envs=[LINE, OTHER_LINE]))
        text = capsys.readouterr().out
        assert "4 cells" in text
        assert "20 episodes, 0 of them finished" in text
        assert "policy@20" in text
        assert "at most" in text

    def test_an_env_that_cannot_be_timed_does_not_hide_the_plan(
        self, config: Config, capsys: pytest.CaptureFixture[str]
    ) -> None:
        print_plan(config(policy_url="http://127.0.0.1:9", env_options={"broken": "the simulator is gone"}))
        text = capsys.readouterr().out
        assert "time unknown" in text
        assert "the simulator is gone" in text
