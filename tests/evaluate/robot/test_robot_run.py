"""Trials on a simulated arm with a scripted operator: the texts that they see, the recordings, and
the results.
"""

from __future__ import annotations

import itertools
import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_fakes import SimulatedTime
from robot_trials import (
    NAMES,
    URLS,
    Arm,
    Policies,
    Reaching,
    ScriptedPerson,
    captured_output,
    judged,
    plan,
    tasks,
    typed,
)

from vlagents_ray.chunking.timeliness import TimeShare
from vlagents_ray.errors import ConfigError, ConnectionLost, MissingState, PolicyFailed
from vlagents_ray.evaluate import EvalConfig, evaluate
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.robot import (
    TrialsInterrupted,
    Verdict,
    evaluate_on_robot,
    schedule,
    unblind,
)
from vlagents_ray.evaluate.robot.run import LoggedTrial, TrialLog
from vlagents_ray.images.jpeg_png import decode
from vlagents_ray.interface import Act, Obs

KEY = b"a key of the plan"


def names_by_trial(config: EvalConfig) -> list[str]:
    return [trial.job.case.policy_id for trial in schedule(plan_cases(config), KEY)]


def test_what_tells_the_policy_is_nowhere_until_all_are_judged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    revealing = [*NAMES, *URLS.values(), "step-4711", "fingerprint-of", "digest-of"]
    hidden = tmp_path / "out" / "trials.hidden.jsonl"
    looks = 0

    def look() -> None:
        nonlocal looks
        looks += 1
        seen = [output(), "\n".join(person.printed).encode(), caplog.text.encode()]
        for path in tmp_path.rglob("*"):
            visible = path.is_file() and path != hidden
            seen += [
                str(path.relative_to(tmp_path)).encode(),
                path.read_bytes() if visible else b"",
            ]
        found = [text for text in revealing if any(text.encode() in one for one in seen)]
        assert not found, f"before question {looks}"

    config = plan(tmp_path / "out", record="all", suite={"episodes": 2})
    with captured_output() as output, caplog.at_level(logging.DEBUG):
        person = ScriptedPerson(judged("sf"), look)
        summary = evaluate_on_robot(config, person, agent_factory=Policies(Talkative))
    assert looks == 3 * 8, "questions for ready, verdict and note in each trial"
    assert (tmp_path / "out" / "recordings" / "trial0008-1" / "meta" / "info.json").is_file()
    lines = [
        json.loads(line) for line in (tmp_path / "out" / "trials.jsonl").read_text().splitlines()
    ]
    assert hidden.stat().st_mode & 0o777 == 0o600
    assert len({len(line) for line in hidden.read_bytes().splitlines()}) == 1, (
        "the size of the file does not reveal the policy"
    )
    shown = {"trial", "attempt", "at", "outcome", "earned", "note", "score", "ending", "hidden"}
    shown |= {"mac"}
    assert [set(line) for line in lines if "outcome" in line] == [shown] * 8
    found = summary.results
    assert found.policy_ids == list(NAMES), "at the end the policies are revealed"
    assert b"step-4711" in (tmp_path / "out" / "results.db").read_bytes()
    assert {one.result.weights for case in found.of(NAMES[0]) for one in case.episodes} == {
        f"digest-of-{NAMES[0]}"
    }


class Talkative(Reaching):
    """A policy whose connection logs its name."""

    def act(self, obs: Obs) -> Act:
        logging.getLogger("vlagents_ray.client.connection").warning(
            "%s: slow, at %s", self.name, URLS[self.name]
        )
        logging.getLogger("ray.serve").error("replica of %s", self.name)
        return super().act(obs)


class VirtualTime(SimulatedTime):
    """A stand-in for the module `time`, including the time of day."""

    time = SimulatedTime.monotonic


def test_a_trial_has_the_ticks_in_time_and_the_ages_of_its_actions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = VirtualTime()
    for module in ("chunking.buffer", "chunking.player", "robot.loop", "robot.pacing"):
        monkeypatch.setattr(f"vlagents_ray.{module}.time", clock)

    class Slow(Reaching):
        """A policy that returns four rows after two and a half ticks."""

        def act(self, obs: Obs) -> Act:
            clock.now += 0.25
            return super().act(obs)

    config = plan(
        tmp_path / "out",
        robot={"hz": 10, "tasks": tasks(max_steps=14)},
        suite={"envs": ["drawer"], "episodes": 1},
    )
    summary = evaluate_on_robot(config, ScriptedPerson(judged("s")), agent_factory=Policies(Slow))

    # The reset waits for the first chunk, whose rows are 250, 350, 450 and 550 ms old. Each later
    # chunk costs the tick after its request, and its rows are 250, 250, 300 and 400 ms old.
    ages_ms = [250.0, 350.0, 450.0, 550.0, *[250.0, 250.0, 300.0, 400.0] * 2]
    expected = TimeShare.from_ages(14, 2, ages_ms)
    for case in summary.results.cases:
        [result] = case.counted
        assert result.steps == 12
        assert result.time_share == pytest.approx(expected, abs=1.0)
    total = summary.total.time_share
    assert total is not None
    assert (total.ticks, total.starved) == (28, 4)


def test_without_a_key_one_is_drawn_that_this_user_alone_can_read(tmp_path: Path) -> None:
    orders = set()
    for number in range(2):
        config = plan(tmp_path / str(number), robot={"key": None})
        policies = Policies()
        evaluate_on_robot(config, ScriptedPerson(judged("s")), agent_factory=policies)
        key = tmp_path / str(number) / "trials.key"
        assert key.stat().st_mode & 0o777 == 0o600
        drawn = [
            trial.job.case.policy_id for trial in schedule(plan_cases(config), key.read_bytes())
        ]
        assert policies.made[:2] == sorted(NAMES), (
            "each policy is rehearsed, in an order that reveals nothing"
        )
        assert policies.made[2:] == drawn, "the key reproduces the order"
        orders.add(key.read_bytes())
    assert len(orders) == 2


def test_a_partial_success_is_none_and_its_score_is_the_share_of_the_rubrics_points(
    tmp_path: Path,
) -> None:
    def answer(question: str) -> str:
        if "grasped" in question:
            return "y"
        return "p" if question.startswith("verdict") else ""

    config = plan(tmp_path / "out", suite={"envs": ["cups"], "episodes": 1})
    summary = evaluate_on_robot(config, ScriptedPerson(answer), agent_factory=Policies())
    [one, other] = [episode.result for case in summary.results.cases for episode in case.episodes]
    assert (
        (one.success_once, one.episode_return)
        == (other.success_once, other.episode_return)
        == (False, 0.25)
    )
    assert summary.total.mean_return == 0.25
    line = json.loads((tmp_path / "out" / "trials.jsonl").read_text().splitlines()[2])
    assert (line["outcome"], line["earned"]) == ("partial", ["the cup is grasped"])


def test_a_task_without_a_rubric_knows_no_partial_success() -> None:
    with pytest.raises(
        ConfigError, match=r"expected only the rubric's marks .*, got a partial success"
    ):
        Verdict("partial", ("lid",)).score({})
    with pytest.raises(ConfigError, match=r"got the parts \['lid'\]"):
        Verdict("partial", ("lid",)).score({"cup": 1})
    with pytest.raises(ConfigError, match="expected a reason for the repetition"):
        Verdict("repeat").score({})


def test_a_repeated_trial_is_counted_with_its_reason_and_played_by_the_same_policy(
    tmp_path: Path,
) -> None:
    lines = ["", "r", "", "r", "somebody walked into the scene", "", "s", "", *["", "s", ""] * 3]
    config, policies = plan(tmp_path / "out", suite={"episodes": 2, "envs": ["drawer"]}), Policies()
    person = ScriptedPerson(typed(lines))
    summary = evaluate_on_robot(config, person, agent_factory=policies)
    order = names_by_trial(config)
    assert policies.made[2:] == [order[0], *order]
    assert any("expected a reason for the repetition" in line for line in person.printed)
    assert any("repeated: somebody walked into the scene" in line for line in person.printed)
    [attempt] = [attempt for case in summary.results.cases for attempt in case.attempts]
    assert (attempt.cause, attempt.error, attempt.retried) == (
        "operator",
        "somebody walked into the scene",
        True,
    )
    assert summary.total.retries == 1
    assert sorted(one.attempts for case in summary.results.cases for one in case.episodes) == [
        1,
        1,
        1,
        2,
    ]


def test_an_arm_that_fails_is_stopped_and_its_trial_played_again_by_the_same_policy(
    tmp_path: Path,
) -> None:
    arm, policies = Arm(fails_at=7), Policies()
    config = plan(tmp_path / "out", suite={"episodes": 1}, robot={"hz": 50})
    person = ScriptedPerson(judged("s"))
    summary = evaluate_on_robot(config, person, robot=arm, agent_factory=policies)
    order = names_by_trial(config)
    assert policies.made[2:] == [order[0], order[1], order[1], *order[2:]]
    assert any("joint 3 is too hot" in line for line in person.printed), (
        "the operator is shown what to fix"
    )
    assert arm.stops >= 5
    [attempt] = [attempt for case in summary.results.cases for attempt in case.attempts]
    assert (attempt.cause, attempt.code) == ("worker", "env_failed")
    assert summary.total.episodes == 4


@pytest.mark.parametrize(("where", "code"), [("reset", "connection_lost"), ("act", "unavailable")])
def test_a_lost_connection_is_told_without_the_policy_and_is_no_failure_of_it(
    tmp_path: Path, where: str, code: str
) -> None:
    class Losing(Reaching):
        def reset(self, obs: Obs, instruction: str | None = None, **kwargs: Any) -> dict[str, Any]:
            self.lost = len(policies.made) == 4  # the server is lost in the second trial
            return self._lose("reset") or super().reset(obs, instruction, **kwargs)

        def act(self, obs: Obs) -> Act:
            self.acts += 1
            return self._lose("act") or super().act(obs)

        def _lose(self, here: str) -> None:
            if self.lost and here == where and (here == "reset" or self.acts > 1):
                raise ConnectionLost(f"{URLS[self.name]} is unavailable")

    policies = Policies(Losing)
    config = plan(
        tmp_path / "out",
        suite={"episodes": 1, "envs": ["drawer"]},
        robot={"tasks": tasks(max_steps=12), "hz": 50},
    )
    person = ScriptedPerson(judged("f"))
    summary = evaluate_on_robot(config, person, agent_factory=policies)
    [told] = [line for line in person.printed if "repeated" in line]
    assert told.strip() == f"repeated: it could not be run ({code})"
    [attempt] = [attempt for case in summary.results.cases for attempt in case.attempts]
    assert attempt.cause == "policy"
    assert ".example" in attempt.error, "the hidden policies are revealed at the end"
    assert summary.total.episodes == 2


def test_a_policy_that_fails_has_failed_without_a_verdict(tmp_path: Path) -> None:
    failing = iter([False] * 2 + [True] + [False] * 100)

    class Failing(Reaching):
        def act(self, obs: Obs) -> Act:
            if next(failing):
                raise PolicyFailed(f"{self.name}: NaN")
            return super().act(obs)

    config = plan(tmp_path / "out", suite={"episodes": 1, "envs": ["drawer"]})
    person = ScriptedPerson(judged("s"))
    summary = evaluate_on_robot(config, person, agent_factory=Policies(Failing))
    assert sum(question.startswith("verdict") for question in person.printed) == 1
    assert any(
        "trial 1: the policy failed, so it counts as a failure" in line for line in person.printed
    )
    assert not any("zebra" in line or "walrus" in line for line in person.printed)
    assert (summary.total.policy_errors, summary.total.success_once.successes) == (1, 1)


def test_a_mistake_in_the_settings_shows_before_the_first_trial(tmp_path: Path) -> None:
    config = plan(tmp_path / "out", robot={"measure": ["elbow"], "max_step": 0.1})
    person = ScriptedPerson(judged("s"))
    with pytest.raises(MissingState, match=r"policy 'policy-walrus'.*elbow"):
        evaluate_on_robot(config, person, agent_factory=Policies())
    assert person.printed == []


def test_the_guard_sees_each_action(tmp_path: Path) -> None:
    class Wild(Reaching):
        def act(self, obs: Obs) -> Act:
            return Act(np.full((4, 2), 7.0, np.float32))

    arm = Arm()
    config = plan(tmp_path / "out", suite={"episodes": 1, "envs": ["drawer"]})
    evaluate_on_robot(config, ScriptedPerson(judged("f")), robot=arm, agent_factory=Policies(Wild))
    assert np.abs(arm.observe().state["joints"]).max() < 1.0


def test_a_trial_has_the_limits_of_the_plan(tmp_path: Path) -> None:
    (tmp_path / "arm.json").write_text('{"low": -0.001, "high": 0.001}')
    robot = {"limits": str(tmp_path / "arm.json")}
    arm, config = (
        Arm(),
        plan(tmp_path / "out", suite={"episodes": 1, "envs": ["drawer"]}, robot=robot),
    )
    evaluate_on_robot(config, ScriptedPerson(judged("f")), robot=arm, agent_factory=Policies())
    assert np.abs(arm.observe().state["joints"]).max() <= 0.001


@pytest.mark.parametrize("mode", ["async", "ensemble"])
def test_it_plays_in_each_mode_of_the_chunk_player_and_closes_what_it_opened(
    tmp_path: Path, mode: str
) -> None:
    closed: list[str] = []

    class Closing(Reaching):
        def close(self) -> None:
            closed.append(self.name)

    arm, policies = Arm(), Policies(Closing)
    robot = {"mode": mode, "tasks": tasks(max_steps=20)}
    config = plan(tmp_path / "out", suite={"episodes": 2, "envs": ["drawer"]}, robot=robot)
    summary = evaluate_on_robot(
        config, ScriptedPerson(judged("s")), robot=arm, agent_factory=policies
    )
    assert sorted(closed) == sorted(policies.made)
    results = [episode.result for case in summary.results.cases for episode in case.episodes]
    assert sum(result.steps for result in results) == arm.applied > 0
    assert all(0 < result.steps <= 20 and result.acts > 0 for result in results)
    assert {result.policy_fingerprint for result in results} == {
        f"fingerprint-of-{name}" for name in NAMES
    }


def test_the_arm_stays_still_while_nobody_is_there(tmp_path: Path) -> None:
    arm, applied = Arm(), []

    def nobody(question: str) -> str:
        applied.append(arm.applied)
        raise EOFError

    config = plan(tmp_path / "out")
    with pytest.raises(TrialsInterrupted, match="after 0 of 8 trials; continue with --resume"):
        evaluate_on_robot(config, ScriptedPerson(nobody), robot=arm, agent_factory=Policies())
    assert applied == [0]
    assert arm.applied == 0


def test_it_goes_on_with_the_next_trial(tmp_path: Path) -> None:
    config, policies = plan(tmp_path / "out"), Policies()
    lines = ["", "s", "", "", "s", "", ""]  # the third trial runs, but gets no verdict
    with pytest.raises(TrialsInterrupted, match="after 2 of 8"):
        evaluate_on_robot(config, ScriptedPerson(typed(lines)), agent_factory=policies)
    assert not (tmp_path / "out" / "results.db").exists()
    with pytest.raises(ConfigError, match="already has trials; resume them"):
        evaluate_on_robot(config, ScriptedPerson(typed([])), agent_factory=policies)
    again = config.model_copy(update={"resume": True})
    later = Policies()
    person = ScriptedPerson(judged("f"))
    summary = evaluate_on_robot(again, person, agent_factory=later)
    assert later.made[2:] == names_by_trial(config)[2:]
    assert any(
        "repeated: the evaluation ended before the verdict" in line for line in person.printed
    )
    assert (
        summary.total.episodes,
        summary.total.success_once.successes,
        summary.total.retries,
    ) == (8, 2, 1)
    assert (
        evaluate_on_robot(again, ScriptedPerson(typed([])), agent_factory=Policies()).total.episodes
        == 8
    )


def test_a_line_that_a_killed_process_left_half_written_is_completed(tmp_path: Path) -> None:
    config = plan(tmp_path / "out")
    with pytest.raises(TrialsInterrupted):
        evaluate_on_robot(
            config, ScriptedPerson(typed(["", "s", "", "", "s", ""])), agent_factory=Policies()
        )
    log = tmp_path / "out" / "trials.jsonl"
    whole = log.read_bytes()
    log.write_bytes(whole[:-40])
    again = config.model_copy(update={"resume": True})
    with pytest.raises(TrialsInterrupted, match="after 2 of 8"):
        evaluate_on_robot(again, ScriptedPerson(typed([])), agent_factory=Policies())
    assert log.read_bytes() == whole, "the hidden line contains the line of the log"


@pytest.mark.parametrize("damage", ["edited", "no JSON", "shortened", "missing"])
def test_a_hidden_file_that_was_changed_is_refused(tmp_path: Path, damage: str) -> None:
    config = plan(tmp_path / "out", resume=True)
    with pytest.raises(TrialsInterrupted):
        evaluate_on_robot(config, ScriptedPerson(typed(["", "s", ""])), agent_factory=Policies())
    hidden = tmp_path / "out" / "trials.hidden.jsonl"
    text = hidden.read_text()
    if damage == "edited":
        hidden.write_text(text.replace(NAMES[0], "another").replace(NAMES[1], "another"))
    elif damage == "no JSON":
        hidden.write_text(text.replace("}", ")"))
    elif damage == "shortened":
        hidden.write_text(text[:-40])
    else:
        hidden.unlink()
    with pytest.raises(
        ConfigError, match=r"hidden line of (trial 1|the plan) is missing in .*, or was changed"
    ):
        evaluate_on_robot(config, ScriptedPerson(judged("s")), agent_factory=Policies())


def test_a_hidden_line_that_a_killed_process_left_incomplete_before_its_first_trial_is_dropped(
    tmp_path: Path,
) -> None:
    config = plan(tmp_path / "out", resume=True, suite={"episodes": 1})
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "trials.hidden.jsonl").write_bytes(b'{"config": {"pol')
    with pytest.raises(TrialsInterrupted):
        evaluate_on_robot(config, ScriptedPerson(typed(["", "s", ""])), agent_factory=Policies())
    assert unblind(tmp_path / "out", KEY.decode()).total.episodes == 1


def test_a_hidden_line_without_its_line_in_the_log_completes_the_log(tmp_path: Path) -> None:
    """The process may be killed after it has written the hidden line, but before the line in the
    log.
    """
    config = plan(tmp_path / "out", resume=True)
    with pytest.raises(TrialsInterrupted):
        evaluate_on_robot(config, ScriptedPerson(typed(["", "s", ""])), agent_factory=Policies())
    log = tmp_path / "out" / "trials.jsonl"
    complete = log.read_bytes().splitlines(keepends=True)
    assert b"outcome" in complete[-1]
    log.write_bytes(b"".join(complete[:-1]))
    hidden = tmp_path / "out" / "trials.hidden.jsonl"
    hidden.write_bytes(hidden.read_bytes() + b'{"result": {"ste')
    with pytest.raises(TrialsInterrupted, match="after 1 of 8"):
        evaluate_on_robot(config, ScriptedPerson(typed([])), agent_factory=Policies())
    assert log.read_bytes() == b"".join(complete)
    assert (
        evaluate_on_robot(
            config, ScriptedPerson(judged("s")), agent_factory=Policies()
        ).total.episodes
        == 8
    )


def _damaged(lines: list[bytes]) -> dict[str, list[bytes]]:
    """Return logs in which lines are deleted, repeated, exchanged or changed."""
    logs = {}
    for first, last in itertools.combinations(range(len(lines) + 1), 2):
        logs[f"without lines {first} to {last}"] = lines[:first] + lines[last:]
    for i, line in enumerate(lines):
        logs[f"line {i} twice"] = [*lines[: i + 1], *lines[i:]]
        for j in range(i):
            exchanged = list(lines)
            exchanged[i], exchanged[j] = lines[j], line
            logs[f"lines {j} and {i} exchanged"] = exchanged
        fields = json.loads(line)
        for name, value in fields.items():
            if value is None:
                continue
            other: Any = f"{value}0" if isinstance(value, str) else [value]
            if isinstance(value, int | float):
                other = value + 1
            for change in ({name: other}, {name: None}, {"again": "a reason"}):
                changed = [*lines]
                changed[i] = json.dumps(
                    fields | change, sort_keys=True, separators=(",", ":")
                ).encode()
                logs[f"line {i} with {change}"] = changed
    return logs


def test_no_line_of_the_log_can_be_changed_or_deleted(tmp_path: Path) -> None:
    config = plan(tmp_path / "out", resume=True, robot={"key": None})
    answers = ["", "f", "", "", "r", "the cup fell", "", "s", ""]
    with pytest.raises(TrialsInterrupted):
        evaluate_on_robot(config, ScriptedPerson(typed(answers)), agent_factory=Policies())
    log, hidden = tmp_path / "out" / "trials.jsonl", tmp_path / "out" / "trials.hidden.jsonl"
    lines, secret = log.read_bytes().splitlines(), hidden.read_bytes()
    assert sum(b"hidden" in line for line in lines) == 4  # the plan, two results, a repetition

    def attempts() -> list[LoggedTrial]:
        with TrialLog(resolve(config)) as opened_log:
            return opened_log.attempts

    whole = attempts()
    refused = 0
    for name, damaged in _damaged(lines).items():
        log.write_bytes(b"".join(line + b"\n" for line in damaged))
        try:
            found = attempts()
        except ConfigError:
            refused += 1
        else:  # only the line of the last hidden line is missing, which is then written again
            assert found == whole, name
            assert log.read_bytes().splitlines() == lines, name
        hidden.write_bytes(secret)
    assert refused >= 100


@pytest.mark.parametrize(
    "changes",
    [{"robot": {"key": "another key"}}, {"suite": {"episodes": 5}}, {"robot": {"hz": 100}}],
)
def test_another_plan_or_key_is_refused(tmp_path: Path, changes: dict[str, Any]) -> None:
    with pytest.raises(TrialsInterrupted):
        evaluate_on_robot(
            plan(tmp_path / "out"), ScriptedPerson(typed(["", "s", ""])), agent_factory=Policies()
        )
    other = plan(tmp_path / "out", resume=True, **changes)
    with pytest.raises(ConfigError, match="expected a log of this plan, robot and key"):
        evaluate_on_robot(other, ScriptedPerson(typed([])), agent_factory=Policies())


def test_a_policy_that_changed_between_trials_ends_it_without_being_named(tmp_path: Path) -> None:
    class Swapped(Reaching):
        def __init__(self, name: str) -> None:
            super().__init__(name, f"/weights/{name}/{len(policies.made) > 4}")

    policies = Policies(Swapped)
    with pytest.raises(
        ConfigError, match="the checkpoint of a policy has changed since its earlier trials"
    ) as raised:
        evaluate_on_robot(
            plan(tmp_path / "out"), ScriptedPerson(judged("s")), agent_factory=policies
        )
    assert not any(name in str(raised.value) for name in NAMES)


@pytest.mark.slow
def test_a_task_ends_early_once_all_its_policies_are_certain(tmp_path: Path) -> None:
    config = plan(tmp_path / "out", suite={"episodes": 20}, stop={"target": 0.5})
    order = names_by_trial(config)
    policies = Policies()
    person = ScriptedPerson(judged("s"))
    summary = evaluate_on_robot(config, person, agent_factory=policies)
    stopped = {case.stopped_at for case in summary.results.cases}
    assert len(stopped) == 1
    [at] = stopped
    assert at is not None
    assert at < 20
    assert len(policies.made) - 2 == 2 * 2 * at
    assert policies.made[2 : 2 + 2 * at] == order[: 2 * at]
    assert summary.state == "complete"
    assert all(case.missing == 0 for case in summary.results.cases)


def test_results_can_be_told_before_the_end_which_the_log_says(tmp_path: Path) -> None:
    config = plan(tmp_path / "out", robot={"key": None})
    with pytest.raises(TrialsInterrupted):
        evaluate_on_robot(
            config, ScriptedPerson(typed(["", "s", "", "", "f", ""])), agent_factory=Policies()
        )
    summary = unblind(tmp_path / "out")
    assert (summary.state, summary.total.episodes) == ("interrupted", 2)
    assert "unblinded" in json.loads(
        (tmp_path / "out" / "trials.jsonl").read_text().splitlines()[-1]
    )
    with pytest.raises(ConfigError, match="expected a log of this key"):
        unblind(tmp_path / "out", "another key")
    with pytest.raises(ConfigError, match="expected the folder of an evaluation on a robot"):
        unblind(tmp_path)
    again = config.model_copy(update={"resume": True})
    whole = evaluate_on_robot(again, ScriptedPerson(judged("s")), agent_factory=Policies())
    assert whole.total.episodes == 8


def test_the_first_start_of_a_scene_is_what_later_trials_of_it_are_set_to(tmp_path: Path) -> None:
    def answer(question: str) -> str:
        if question.startswith("Enter"):
            return next(looks)
        return "s" if question.startswith("verdict") else ""

    looks = iter(["l", "", "l", ""])
    config = plan(tmp_path / "out", suite={"episodes": 1, "envs": ["drawer"]})
    person = ScriptedPerson(answer)
    evaluate_on_robot(config, person, agent_factory=Policies())
    start = tmp_path / "out" / "scenes" / "drawer-scene1" / "front.jpg"
    overlay = start.parent.with_name("overlay-front.jpg")
    assert [
        line.strip()
        for line in person.printed
        if "scene" in line and "start picture" in line and "yet" in line
    ]
    assert any(str(start) in line for line in person.printed)
    assert any(line.strip() == str(overlay) for line in person.printed)
    assert decode(start.read_bytes()).shape == decode(overlay.read_bytes()).shape == (32, 32, 3)


def test_a_first_trial_that_is_repeated_takes_the_start_pictures_again(tmp_path: Path) -> None:
    class Flashing(Arm):
        seen = 0

        def observe(self) -> Obs:
            self.seen += 1
            return replace(
                super().observe(),
                cameras={"front": np.full((8, 8, 3), 5 * self.seen % 256, np.uint8)},
            )

    pictures: list[bytes] = []

    def keep() -> None:
        pictures.extend(path.read_bytes() for path in tmp_path.rglob("front.jpg"))

    lines = ["", "r", "the cup stood on another mark", "", "s", "", "", "s", ""]
    config = plan(tmp_path / "out", suite={"episodes": 1, "envs": ["drawer"]})
    evaluate_on_robot(
        config, ScriptedPerson(typed(lines), keep), robot=Flashing(), agent_factory=Policies()
    )
    assert len(pictures) == 8, "at each question except the first"
    assert list(dict.fromkeys(pictures)) == [pictures[0], pictures[3]]
    assert pictures[3:] == [pictures[3]] * 5, "the second policy gets the same initial scene"


def test_a_plan_on_a_robot_is_not_taken_for_a_simulation(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected a plan in simulation"):
        evaluate(plan(tmp_path / "out"))
