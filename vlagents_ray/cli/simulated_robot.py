"""Episodes of an environment in a robot's control loop, driven by a policy, an operator, or
both.
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterable

import typer

from vlagents_ray.abilities import HasControl, ability
from vlagents_ray.chunking.choice import choose_for
from vlagents_ray.chunking.control import Leader, RobotControl
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.chunking.timeliness import in_words
from vlagents_ray.cli.console import errors, out
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import Contract, require_match
from vlagents_ray.datasets.episode import Label
from vlagents_ray.envs.base import EvalEnv, make_env
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Agent
from vlagents_ray.overrides import parse_settings
from vlagents_ray.policies.wrapper import Wrapper, build_agent
from vlagents_ray.robot import Guard, LoopOptions, run_loop
from vlagents_ray.robot.leaders import TeleoperatedAgent, leader_named
from vlagents_ray.robot.record import Recorder
from vlagents_ray.robot.simulated import EnvRobot
from vlagents_ray.robot.terminal import typed_keys
from vlagents_ray.viewers import EpisodeViewer, open_viewer

KEYS = "p pauses and continues; y success, n failure, x discard end the episode; q quits"
_HZ = 10.0  # control rate of environments whose contract declares no rate
_LABELS: dict[str, Label] = {"y": "success", "n": "failure", "x": "discard"}
_MOVES = {
    "autonomous": "the policy moves the robot",
    "human": "you move the robot",
    "paused": "nothing moves the robot",
}


class EnvPolicy(Wrapper):
    """A policy in an environment. If the policy's contract describes no actions, the environment's
    contract replaces it.

    Args:
        agent: The policy.
        env_contract: The contract of the environment.
    """

    def __init__(self, agent: Agent, env_contract: Contract) -> None:
        super().__init__(agent)
        self._env_contract = env_contract
        self._loaded = False

    def initialize(self) -> None:
        """Load the policy, but only once, although each run of the control loop calls
        `initialize`.
        """
        if not self._loaded:
            super().initialize()
        self._loaded = True

    @property
    def contract(self) -> Contract:
        """The policy's contract, or the environment's contract if the policy's describes no
        actions.
        """
        contract = self.agent.contract
        if contract is None or contract.action.relative is None:
            return self._env_contract
        return contract


def drive(options: argparse.Namespace) -> int:
    """Run the command `vlagents-ray robot --env`.

    Args:
        options: The options of the command.

    Returns:
        The exit status.
    """
    try:
        with errors():
            run = RobotRun(options)
            try:
                run.play(range(options.seed, options.seed + options.episodes))
            except KeyboardInterrupt:
                recorded = ""
                if run.recorder is not None:
                    recorded = f"; {run.recorder.episodes} episodes are in {options.record}"
                raise KeyboardInterrupt(f"interrupted{recorded}") from None
    except typer.Exit as ended:
        return ended.exit_code
    return 0


class RobotRun:
    """One run of `vlagents-ray robot --env`.

    Args:
        options: The options of the command.

    Raises:
        ConfigError: A setting cannot be parsed.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self._env_options = parse_settings(options.env_set, "--env-set")
        self._settings = parse_settings(options.set, "--set")

        self.verdict: Label | None = None  # the operator's label of the running episode
        self.over = False  # whether the operator has ended the run
        self.recorder: Recorder | None = None

        self._control: RobotControl | None = None
        self._viewer: EpisodeViewer | None = None
        self._printed: str | None = None  # the last printed source of motion

    def play(self, seeds: Iterable[int]) -> None:
        """Run an episode for each seed, and print its outcome.

        Raises:
            ConfigError: The settings are inconsistent.
            ContractMismatch: The policy does not fit the environment.
        """
        with contextlib.ExitStack() as stack:
            env = stack.enter_context(make_env(self.options.env, **self._env_options))
            hz = self.options.hz or env.contract.control_hz or _HZ
            leader = self._leader(env.contract, stack)
            guard = Guard(
                env.contract,
                max_step=self.options.max_step,
                limits=self.options.limits,
                hz=hz,
                soft_start_s=self.options.soft_start_s,
            )
            agent = stack.enter_context(self._agent(env.contract, leader, guard, hz))
            has_control = ability(agent, HasControl)
            self._control = None if has_control is None else has_control.control

            if self.options.record is not None:
                opened = Recorder(self.options.record, hz, interventions=leader is not None)
                self.recorder = stack.enter_context(opened)
                out.print(opened.description)
            if self.options.rerun is not None:
                self._viewer = stack.enter_context(open_viewer(self.options.rerun))

            for seed in seeds:
                if self.over:
                    break
                self._play(env, agent, seed, hz, guard)

        if self.recorder is not None:  # the recorder is closed, so that all frames are written
            out.print(
                f"recorded: {self.recorder.episodes} episodes in {self.options.record}, "
                f"{self.recorder.dropped} frames dropped"
            )
        if self._viewer is not None:
            out.print(self._viewer.report())

    def _play(self, env: EvalEnv, agent: Agent, seed: int, hz: float, guard: Guard) -> None:
        """Run one episode, and print its outcome."""
        self.verdict = None
        recorder = self.recorder
        robot = EnvRobot(env, seed, endless=self.options.teleop is not None)
        out.print(f"seed {seed}: {env.instruction}")

        def label() -> Label:
            """Return the operator's label of the episode, or else the environment's label."""
            return self.verdict or ("success" if robot.success else "failure")

        def check_end() -> bool:
            """Update the label of the episode, print the source of motion, and return whether the
            episode has ended.
            """
            if recorder is not None and (recorder.interventions or self.over):
                recorder.label(label())
            self._print_source_of_motion(has_begun=robot.steps > 0)
            return robot.ended or self.verdict is not None

        has_policy = self.options.policy is not None
        options = LoopOptions(
            # The chunk player of a policy already has the control.
            guard=None if has_policy else guard,
            reset_options={"seed": seed, "env": self.options.env} if has_policy else {},
            viewer=self._viewer,
        )
        report = run_loop(
            robot,
            agent,
            hz=hz,
            until=check_end,
            instruction=env.instruction,
            recorder=recorder,
            options=options,
        )
        out.print(
            f"  {label()}: {robot.steps} steps, {report.interventions} by the operator; paused for "
            f"{report.paused} ticks"
        )
        time_share = report.timeliness.time_share
        if time_share.ticks:
            out.print(f"  {in_words(time_share)}")

    def _leader(self, contract: Contract, stack: contextlib.ExitStack) -> Leader | None:
        """Open the operator's device, if the options name one."""
        if self.options.teleop is None:
            return None
        has_terminal = stack.enter_context(typed_keys(self._press))
        open_leader = leader_named("--teleop", self.options.teleop)
        leader = stack.enter_context(open_leader(contract, step=self.options.step, measure=None))
        help_text = getattr(leader, "help", "")
        if help_text:
            out.print(help_text)
        if has_terminal:
            out.print(KEYS)
        return leader

    def _press(self, key: str) -> bool:
        """Handle a key of the terminal; return whether the key is known."""
        if key in _LABELS:
            self.verdict = _LABELS[key]
        elif key == "p":
            self._pause()
        elif key == "q":
            self._quit()
        else:
            return False
        return True

    def _agent(self, contract: Contract, leader: Leader | None, guard: Guard, hz: float) -> Agent:
        """Build the agent: the operator alone, or a policy that the operator may override."""
        if self.options.policy is None:
            if leader is None:
                raise ConfigError(
                    "robot: expected a policy, --teleop, or both, got neither; give one of them"
                )
            return TeleoperatedAgent(leader, contract)

        is_remote = "://" in self.options.policy
        if is_remote and self._settings:
            raise ConfigError(
                f"--set: expected no settings for {self.options.policy}, a server with its own "
                f"settings, got {sorted(self._settings)}; leave them out"
            )
        inner: Agent
        if is_remote:
            inner = RemoteAgent(self.options.policy)
        else:
            inner = build_agent(self.options.policy, self._settings)

        policy = EnvPolicy(inner, contract)
        policy.initialize()
        require_match(inner.contract, contract)
        settings = self._player_settings(policy, hz)
        return ChunkPlayer(policy, settings, check=guard, override=leader)

    def _player_settings(self, policy: Agent, hz: float) -> PlayerSettings:
        """Return the settings of the chunk player. In a mode that the options name, the simulation
        waits for its policy without a time limit.
        """
        if self.options.mode != "auto":
            return PlayerSettings(self.options.mode, self.options.execute)
        choice = choose_for(policy, hz=hz, execute=self.options.execute)
        out.print(choice.line)
        return choice.settings

    def _pause(self) -> None:
        """Pause motion, or continue it."""
        if self._control is None:
            return
        if self._control.reason is None:
            self._control.pause()
        else:
            self._control.resume()

    def _print_source_of_motion(self, has_begun: bool) -> None:
        """Print the source of motion, or the reason of a pause, if it has changed."""
        if self._control is None:
            return
        reason = self._control.reason
        if not (has_begun or reason):
            return

        if reason is None:
            line = _MOVES.get(self._control.state, "the robot is stopped")
        else:
            line = f"{reason}; p continues"
        if line != self._printed:
            if reason is not None:
                out.bell()
            out.print(f"  {line}")
        self._printed = line

    def _quit(self) -> None:
        """End the run, and discard the running episode."""
        self.verdict = "discard"
        self.over = True
