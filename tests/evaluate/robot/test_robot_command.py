"""`vlagents-ray eval --robot` with policies that the command serves itself, and an operator at its
terminal.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml
from eval_fakes import PYTHONPATH
from robot_trials import Policies, ScriptedPerson, tasks, typed
from robot_trials import plan as robot_plan
from typer.testing import CliRunner

from vlagents_ray.cli.main import app
from vlagents_ray.evaluate import Results
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.plan.config import EvalConfig
from vlagents_ray.evaluate.robot import TrialsInterrupted, evaluate_on_robot, schedule

NAMES = ("policy-zebra", "policy-walrus")
_ASKS = re.compile(r"(Enter when the scene is ready.*?|verdict \(.*?\)|note): $", re.DOTALL)


def write_plan(file: Path) -> None:
    """Write a plan with two policies of different chunks; the address of one is a socket that does
    not identify it.
    """
    policies = [
        {"name": name, "source": "noop", "config": {"action_dim": 2, "chunk": chunk}}
        for chunk, name in enumerate(NAMES, start=3)
    ]
    robot = {
        "hz": 50,
        "mode": "open_loop",
        "safe": "hold",
        "key": "the key of the plan",
        "tasks": tasks(),
    }
    plan = {"policies": policies, "suites": [{"envs": ["drawer"], "episodes": 2}], "robot": robot}
    file.write_text(yaml.safe_dump(plan))


class Terminal:
    """The command with a person who types answers; `read` has all of its output."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process = process
        self.read = b""

    def asked(self) -> str:
        """Return the next question; "" when the command has ended."""
        question = b""
        assert self.process.stdout is not None
        while byte := self.process.stdout.read(1):
            question, self.read = question + byte, self.read + byte
            if _ASKS.search(question.decode(errors="replace")):
                return question.decode().strip().rpartition("\n")[2]
        return ""

    def type(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line.encode() + b"\n")
        self.process.stdin.flush()


@contextmanager
def evaluating(plan: Path, out: Path, *options: str) -> Iterator[Terminal]:
    command = [
        sys.executable,
        "-c",
        "from vlagents_ray.cli import main; main()",
        "eval",
        str(plan),
        "--out",
        str(out),
    ]
    command += ["--robot", "robot_trials:Arm", "--operator", "terminal", *options]
    environment = os.environ | {"PYTHONPATH": PYTHONPATH, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        bufsize=0,
        env=environment,
    ) as process:
        try:
            yield Terminal(process)
        finally:
            process.terminate()


def require_blind(terminal: Terminal, out: Path) -> None:
    visible = [
        path for path in out.rglob("*") if path.is_file() and path.name != "trials.hidden.jsonl"
    ]
    seen = [terminal.read] + [path.read_bytes() for path in visible]
    seen += [str(path.relative_to(out)).encode() for path in out.rglob("*")]
    for text in (*NAMES, "serve://", "zebra", "walrus", "noop"):
        assert not any(text.encode() in one for one in seen), text


@pytest.mark.server
@pytest.mark.slow
def test_it_serves_both_is_killed_goes_on_and_then_tells(tmp_path: Path) -> None:
    plan, out = tmp_path / "plan.yaml", tmp_path / "out"
    write_plan(plan)
    with evaluating(plan, out) as terminal:
        for answer in ("", "s", "", ""):  # one complete trial, and the beginning of the next
            assert terminal.asked()
            require_blind(terminal, out)
            terminal.type(answer)
        assert terminal.asked().startswith("verdict")
        require_blind(terminal, out)
        terminal.process.kill()
    verdicts = iter("sff")
    with evaluating(plan, out, "--resume") as terminal:
        while question := terminal.asked():
            require_blind(terminal, out)
            terminal.type(next(verdicts) if question.startswith("verdict") else "")
        assert terminal.process.wait() == 0
    assert b"repeated: the evaluation ended before the verdict" in terminal.read
    assert all(name.encode() in terminal.read for name in NAMES), "the table of results at the end"
    results = Results.load(out)
    config = EvalConfig.model_validate(results.runs[-1].config)
    order = [trial.job.key for trial in schedule(plan_cases(config), b"the key of the plan")]
    outcomes = {
        one.result.key: one.result.success_once for case in results.cases for one in case.episodes
    }
    assert [outcomes[key] for key in order] == [True, True, False, False]
    assert [attempt.cause for case in results.cases for attempt in case.attempts] == ["operator"]
    assert {one.result.transport for case in results.cases for one in case.episodes} == {"shm"}


def test_what_was_judged_can_be_told_before_the_end(tmp_path: Path) -> None:
    config = robot_plan(tmp_path / "out", robot={"key": "the key of the plan"})
    with pytest.raises(TrialsInterrupted):
        evaluate_on_robot(config, ScriptedPerson(typed(["", "s", ""])), agent_factory=Policies())
    write_plan(tmp_path / "plan.yaml")
    command = ["eval", str(tmp_path / "plan.yaml"), "--out", str(tmp_path / "out")]
    answer = CliRunner().invoke(app, [*command, "--robot", "robot_trials:Arm", "--unblind"])
    assert answer.exit_code == 0
    assert all(name in answer.stdout for name in NAMES)
    assert "1/4" in answer.stdout


ROBOT = ["--robot", "robot_trials:Arm"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--operator", "terminal"], "expected --robot with ['--operator'], got none"),
        (["--unblind"], "expected --robot with ['--unblind'], got none"),
        ([*ROBOT, "--dry-run"], "--robot and ['--dry-run'] exclude each other"),
        ([*ROBOT, "--operator", "owl"], "--operator: expected 'page' or 'terminal', got 'owl'"),
        ([*ROBOT, "--unblind"], "expected the folder of an evaluation on a robot"),
        ([*ROBOT, "--track", "wandb"], "['--track'] exclude each other"),
        (["simulation.yaml", *ROBOT], "robot.tasks"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write_plan(tmp_path / "plan.yaml")
    simulation = {"policies": [{"source": "noop"}], "suites": [{"envs": ["tabletop"]}]}
    (tmp_path / "simulation.yaml").write_text(json.dumps(simulation))
    plan = [] if options[0].endswith("yaml") else ["plan.yaml"]
    answer = CliRunner().invoke(app, ["eval", *plan, *options, "--out", "out"])
    assert answer.exit_code == 2
    assert said in answer.stderr
