"""The mode of an episode in real time is the one that a robot gets, and the report names it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_fakes import LINE, Line, ToZero
from in_process_evaluation import flat_config
from rich.console import Console

from vlagents_ray.chunking.choice import choose_for
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.evaluate import Summary, evaluate, print_summary
from vlagents_ray.evaluate.report.page import FILE
from vlagents_ray.evaluate.results.modes import modes
from vlagents_ray.interface import Act, Obs
from vlagents_ray.policies.base.checkpoint import find_checkpoint
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.local_agent import LocalPolicy
from vlagents_ray.success import Solved, SuccessCurve, write_curves

RATE_HZ = 10.0


class Chunks(ToZero):
    """A policy with chunks of eight rows."""

    delta: bool | None = None
    folder: Path | None = None

    def __init__(self) -> None:
        super().__init__(chunk=8)

    @property
    def contract(self) -> Contract:
        return Contract(action=ActionSpec(dim=1, delta=self.delta), chunk=8)

    def initialize(self) -> None:
        if self.folder is not None:
            find_checkpoint(str(self.folder))


class Declared(Chunks):
    """A policy that declares relative actions, and counts its answers."""

    delta = True
    acts = 0

    def act(self, obs: Obs) -> Act:
        Declared.acts += 1
        return super().act(obs)


def run(policy: type, out: Path, clock: dict[str, Any]) -> Summary:
    args = ServerArgs(policy=f"{__name__}:{policy.__name__}")
    plan = flat_config(
        envs=[LINE],
        episodes=1,
        seed=3,
        workers=0,
        video="none",
        out=out,
        clock={"neutral": [0.0], **clock},
    )
    return evaluate(plan, agent_factory=lambda: LocalPolicy(args, {}))


@pytest.mark.parametrize(
    ("policy", "clock", "waited", "line"),
    [
        (
            Declared,
            {"latency": 0.1},
            "async",
            "the contract declares relative actions; no measured",
        ),
        (Chunks, {"latency": 0.1}, "open_loop", "executes 4 of 8 rows and waits"),
        (Declared, {"latency": 0.5}, "open_loop", "5 rows of delay (500 ms) is more than half of"),
        (Declared, {"latency": "measured"}, "async", "the contract declares relative actions"),
        (Chunks, {"latency": 0.1, "mode": "async"}, "async", "as set"),
    ],
)
def test_the_report_names_the_mode_that_a_robot_gets(
    policy: type, clock: dict[str, Any], waited: str, line: str, tmp_path: Path
) -> None:
    summary = run(policy, tmp_path, clock)
    [text] = modes(summary.results)
    assert text.startswith(f"policy: mode {waited}")
    assert line in text

    latency = clock["latency"]
    agent = LocalPolicy(ServerArgs(policy=f"{__name__}:{policy.__name__}"), {})
    agent.initialize()
    try:
        robot = choose_for(
            agent,
            mode=clock.get("mode", "auto"),
            hz=RATE_HZ,
            delay_s=None if latency == "measured" else latency,
        )
    finally:
        agent.close()
    assert text == f"policy: {robot.line}"

    console = Console(width=1000, record=True)
    print_summary(console, summary)
    assert text in console.export_text()
    assert text in (summary.out / FILE).read_text()

    [case] = summary.results.cases
    [episode] = case.episodes
    ticks = clock["latency"] if isinstance(clock["latency"], float) else 0.0
    if waited == "open_loop":  # the robot stands for each answer, but not for an answer in vain
        assert episode.result.starved == episode.result.ticks_waited > round(10 * ticks)
    elif ticks:
        assert episode.result.starved == round(10 * ticks), "only the first answer"


def test_a_synchronous_evaluation_has_no_mode(tmp_path: Path) -> None:
    plan = flat_config(envs=[LINE], episodes=1, seed=3, workers=0, video="none", out=tmp_path)
    args = ServerArgs(policy=f"{__name__}:Declared")
    assert modes(evaluate(plan, agent_factory=lambda: LocalPolicy(args, {})).results) == []


def test_the_measured_number_of_rows_is_executed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint = tmp_path / "checkpoint"
    checkpoint.mkdir()
    (checkpoint / "weights.pt").write_bytes(b"1")
    curve = SuccessCurve(
        "line", RATE_HZ, "async", {"execute": 5}, {0: Solved(9, 10, 9.0), 1: Solved(8, 10, 9.0)}
    )
    write_curves(checkpoint, [curve])
    for folder, acts in ((None, Line.max_steps), (checkpoint, 2)):
        monkeypatch.setattr(Declared, "acts", 0)
        monkeypatch.setattr(Declared, "folder", folder)
        summary = run(Declared, tmp_path / str(acts), {"latency": 0.1})
        assert Declared.acts == acts
    [line] = modes(summary.results)
    assert line.endswith("; measured: 80 % of 10 at 1 row, line")
    assert np.isfinite(summary.results.cases[0].counted[0].episode_return)
