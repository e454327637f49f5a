"""Episodes of an environment in the control loop of a robot: driven by a policy, an operator, or
both.
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterable

import typer

from vlagents_ray.chunking.control import Leader, RobotControl
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.cli.console import errors, out
from vlagents_ray.cli.options import parse_settings
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import Contract, require_match
from vlagents_ray.datasets.episode import Label
from vlagents_ray.envs.base import EvalEnv, make_env
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Agent
from vlagents_ray.policies.wrapper import Wrapper, build_agent
from vlagents_ray.robot import Guard, run_loop
from vlagents_ray.robot.leaders import TeleoperatedAgent, leader_named
from vlagents_ray.robot.record import Recorder
from vlagents_ray.robot.simulated import EnvRobot
from vlagents_ray.robot.terminal import typed_keys
from vlagents_ray.viewers import EpisodeViewer, open_viewer

KEYS = "p pauses and continues; y success, n failure, x discard end the episode; q quits"
_HZ = 10.0  # of environments that state no rate
_LABELS: dict[str, Label] = {"y": "success", "n": "failure", "x": "discard"}
_MOVES = {
    "autonomous": "the policy moves the robot",
    "human": "you move the robot",
    "paused": "nothing moves the robot",
}


class EnvPolicy(Wrapper):
    """A policy in an environment, which supplies the action contract if the policy states none."""

    def __init__(self, agent: Agent, env: Contract) -> None:
        super().__init__(agent)
        self._env = env
        self._loaded = False

    def initialize(self) -> None:
        """Load the policy once, although each run of the control loop initializes its agent."""
        if not self._loaded:
            super().initialize()
        self._loaded = True

    @property
    def contract(self) -> Contract:
        """The policy's contract, or the environment's if that states no actions."""
        own = self.agent.contract
        return self._env if own is None or own.action.relative is None else own


def drive(options: argparse.Namespace) -> int:
    """Play by the options of `vlagents-ray robot --env`, and return the command's exit status."""
    try:
        with errors():
            run = RobotRun(options)
            try:
                run.play(range(options.seed, options.seed + options.episodes))
            except KeyboardInterrupt:
                kept = (
                    ""
                    if run.recorder is None
                    else f"; {run.recorder.episodes} episodes are in {options.record}"
                )
                raise KeyboardInterrupt(f"interrupted{kept}") from None
    except typer.Exit as ended:
        return ended.exit_code
    return 0


class RobotRun:
    """A run of `vlagents-ray robot --env` with its options."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self._env_options = parse_settings(options.env_set, "--env-set")
        self._settings = parse_settings(options.set, "--set")
        self.verdict: Label | None = None  # the operator's label of the running episode
        self.over = False  # the operator has ended the run
        self.recorder: Recorder | None = None
        self._control: RobotControl | None = None
        self._viewer: EpisodeViewer | None = None
        self._said: str | None = None  # the printed source of motion

    def play(self, seeds: Iterable[int]) -> None:
        """Play an episode for each seed, and print its outcome.

        Raises:
            ConfigError: The settings are inconsistent.
            ContractMismatch: The policy does not fit the environment.
        """
        with contextlib.ExitStack() as stack:
            env = stack.enter_context(make_env(self.options.env, **self._env_options))
            hz = self.options.hz or env.contract.control_hz or _HZ
            leader = self._leader(env.contract, stack)
            limits, soft_start_s = self.options.limits, self.options.soft_start_s
            guard = Guard(
                env.contract,
                max_step=self.options.max_step,
                limits=limits,
                hz=hz,
                soft_start_s=soft_start_s,
            )
            agent = stack.enter_context(self._agent(env.contract, leader, guard))
            self._control = agent.control
            if self.options.record is not None:
                opened = Recorder(self.options.record, hz, interventions=leader is not None)
                self.recorder = stack.enter_context(opened)
            if self.options.rerun is not None:
                self._viewer = stack.enter_context(open_viewer(self.options.rerun))
            for seed in seeds:
                if self.over:
                    break
                self._play(env, agent, seed, hz, guard)
        if self.recorder is not None:  # closed, so everything is written
            kept = f"{self.recorder.episodes} episodes in {self.options.record}"
            out.print(f"recorded: {kept}, {self.recorder.dropped} frames dropped")
        if self._viewer is not None:
            out.print(self._viewer.report())

    def _play(self, env: EvalEnv, agent: Agent, seed: int, hz: float, guard: Guard) -> None:
        self.verdict, recorder = None, self.recorder
        robot = EnvRobot(env, seed, endless=self.options.leader is not None)
        out.print(f"seed {seed}: {env.instruction}")

        def label() -> Label:
            return self.verdict or ("success" if robot.success else "failure")

        def ended() -> bool:
            if recorder is not None and (recorder.interventions or self.over):
                recorder.label(label())
            self._say_who_moves(begun=robot.steps > 0)
            return robot.ended or self.verdict is not None

        options = {} if self.options.policy is None else {"seed": seed, "env": self.options.env}
        report = run_loop(
            robot,
            agent,
            hz=hz,
            instruction=env.instruction,
            reset_options=options,
            guard=guard if self.options.policy is None else None,
            recorder=recorder,
            viewer=self._viewer,
            until=ended,
        )
        counts = (
            f"{robot.steps} steps, {report.interventions} by the operator; paused for "
            f"{report.paused} ticks"
        )
        out.print(f"  {label()}: {counts}")

    def _leader(self, contract: Contract, stack: contextlib.ExitStack) -> Leader | None:
        if self.options.leader is None:
            return None
        has_terminal = stack.enter_context(typed_keys(self._press))
        open_leader = leader_named("--leader", self.options.leader)
        leader = stack.enter_context(open_leader(contract, step=self.options.step, measure=None))
        explained = getattr(leader, "help", "")
        if explained:
            out.print(explained)
        if has_terminal:
            out.print(KEYS)
        return leader

    def _press(self, key: str) -> bool:
        """Do what a key of the terminal means; return whether it has a meaning."""
        if key in _LABELS:
            self.verdict = _LABELS[key]
        elif key == "p":
            self._pause()
        elif key == "q":
            self._quit()
        else:
            return False
        return True

    def _agent(self, contract: Contract, leader: Leader | None, guard: Guard) -> Agent:
        if self.options.policy is None:
            if leader is None:
                raise ConfigError(
                    "robot: got neither a policy nor --leader, want one of them, or both"
                )
            return TeleoperatedAgent(leader, contract)
        remote = "://" in self.options.policy
        if remote and self._settings:
            raise ConfigError(
                f"--set: got {sorted(self._settings)}, but {self.options.policy} has its settings "
                "already"
            )
        inner = (
            RemoteAgent(self.options.policy)
            if remote
            else build_agent(self.options.policy, self._settings)
        )
        policy = EnvPolicy(inner, contract)
        policy.initialize()
        require_match(inner.contract, contract)
        settings = PlayerSettings(self.options.mode, self.options.execute)
        return ChunkPlayer(policy, settings, check=guard, override=leader)

    def _pause(self) -> None:
        if self._control is None:
            return
        if self._control.reason is None:
            self._control.pause()
        else:
            self._control.resume()

    def _say_who_moves(self, begun: bool) -> None:
        reason = None if self._control is None else self._control.reason
        if self._control is None or not (begun or reason):
            return
        moves = _MOVES.get(self._control.state, "the robot is stopped")
        now = moves if reason is None else f"{reason}; p continues"
        if now != self._said:
            if reason is not None:
                out.bell()
            out.print(f"  {now}")
        self._said = now

    def _quit(self) -> None:
        self.verdict, self.over = "discard", True
