"""A policy on a vlagents_ray server as a policy of LeRobot."""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, cast

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.policies.rtc.configuration_rtc import RTCConfig

from lerobot_policy_vlagents.configuration_vlagents import TRAINING, VlagentsConfig
from lerobot_policy_vlagents.observations import (
    ObservationMapping,
    require_fit,
    shapes_of_batch,
    shapes_of_features,
)
from vlagents_ray import Act, Obs, RemoteAgent
from vlagents_ray.errors import ConfigError, ContractMismatch, InvalidAction
from vlagents_ray.interface import DELAY, LEFTOVER, TICKS
from vlagents_ray.robot.fit import Fit, Trained

# Settings of RTCConfig that are rejected, since the server has separate settings.
_GUIDANCE = ("max_guidance_weight", "prefix_attention_schedule")
logger = logging.getLogger(__name__)


class VlagentsPolicy(PreTrainedPolicy):
    """A policy on a server. Each row of a batch, i.e. each robot or environment, is a session."""

    config_class, name = VlagentsConfig, "vlagents"

    def __init__(self, config: VlagentsConfig, *, dataset_meta: Any = None, **_: Any) -> None:
        """Connect to the server, and compare its policy with the features.

        Args:
            config: The options, and the features, which LeRobot's `make_policy` has set.
            dataset_meta: The metadata of the dataset that is recorded, if there is one.

        Raises:
            ConfigError: An option is missing or wrong.
            ContractMismatch: The policy needs a missing input, or its actions do not fit the robot.
            PolicyUnavailable: The server was not ready within `connect_timeout_s`.
        """
        super().__init__(config)
        self._robot = _Robot(config, dataset_meta)
        # LeRobot's evaluation of several tasks at once calls one policy on several threads.
        self._threads = threading.local()
        self._threads.sessions = sessions = _Sessions(self._robot)
        self._of_all_threads: _Sessions | None = None  # used with real-time chunking
        self._robot.check_features(sessions.agent)

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path | None = None,
        *,
        config: VlagentsConfig | None = None,
        **kwargs: Any,
    ) -> VlagentsPolicy:
        """Return the policy of a configuration; raises `ConfigError` for a checkpoint, which only a
        server can load.
        """
        if pretrained_name_or_path is not None or config is None:
            raise ConfigError(
                "policy.path: expected none with policy.type=vlagents, as the server loads the "
                f"checkpoint, got {str(pretrained_name_or_path)!r}; --policy.url selects the server"
            )
        return cls(config, **{key: value for key, value in kwargs.items() if key == "dataset_meta"})

    def reset(self) -> None:
        """Begin new episodes with the next observations."""
        self._sessions.reset()

    def select_action(self, batch: dict[str, Any], **_: Any) -> torch.Tensor:
        """Return the next row of each session's chunk, (B, D) float32; after a chunk's last row,
        request a new chunk.

        Args:
            batch: Images (B, C, H, W) in [0, 1], states (B, D), and the `task`, with LeRobot's
                names.
        """
        return torch.from_numpy(self._sessions.next_rows(batch))

    def predict_action_chunk(
        self,
        batch: dict[str, Any],
        *,
        inference_delay: int = 0,
        prev_chunk_left_over: torch.Tensor | None = None,
        **_: Any,
    ) -> torch.Tensor:
        """Return a new chunk of each session, (B, H, D) float32; it does not affect
        `select_action`.

        Args:
            batch: The same as for `select_action`.
            inference_delay: Real-time chunking: the number of rows of the plan that will have been
                executed.
            prev_chunk_left_over: Real-time chunking: the plan beginning at this observation, (H',
                D) or (B, H', D), which LeRobot pads with rows of zeros.
        """
        rtc = getattr(self.config, "rtc_config", None)
        left = prev_chunk_left_over if rtc is None or rtc.enabled else None
        chunks = self._sessions.chunks(batch, _plans(left, inference_delay, _size(batch)))
        if len(lengths := {len(rows) for rows in chunks}) > 1:
            raise InvalidAction(
                f"predict_action_chunk: expected chunks of one length, got {sorted(lengths)} "
                "rows; set a length in the server's deployment file, or use select_action"
            )
        return torch.from_numpy(np.stack(chunks))

    def supports_rtc(self) -> bool:
        """Return True; raises `ConfigError` if the server's policy does not continue the
        executed plan.
        """
        if not self._sessions.agent.continues_plans:
            raise ConfigError(
                "inference.type: expected sync, as the server's policy ignores the plan that is "
                "executed, so that its chunks would not fit together, got rtc; use "
                "--inference.type=sync, serve a policy with real-time chunking and `actions: "
                "chunk` (pi0, openpi, or smolvla, pi0 and pi05 of lerobot), or, to keep the robot "
                "moving while another policy computes, drive it with `vlagents-ray robot`"
            )
        return True

    def init_rtc_processor(self) -> None:
        """Let all threads share one session, since LeRobot computes chunks and calls `reset` on
        different threads.

        LeRobot calls this once `config.rtc_config` is set. Raises `ConfigError` for settings that
        only the server may set.
        """
        wanted, usual = self.config.rtc_config, RTCConfig()
        if changed := [name for name in _GUIDANCE if getattr(wanted, name) != getattr(usual, name)]:
            raise ConfigError(
                f"inference.rtc.{changed[0]}: expected none here, as the server guides the "
                f"chunks, got {getattr(wanted, changed[0])}; set it in its deployment file (for "
                "lerobot: overrides: {rtc_config: …})"
            )
        self._of_all_threads = self._sessions

    def forward(self, batch: dict[str, Any]) -> NoReturn:
        """Raise an error, as the policy cannot be trained here."""
        raise ConfigError(TRAINING)

    def get_optim_params(self) -> NoReturn:
        """Raise an error, as the policy cannot be trained here."""
        raise ConfigError(TRAINING)

    @property
    def _sessions(self) -> _Sessions:
        if self._of_all_threads is not None:
            return self._of_all_threads
        if not hasattr(self._threads, "sessions"):
            self._threads.sessions = _Sessions(self._robot)
        return cast(_Sessions, self._threads.sessions)


class _Robot:
    """The robot or the environments of LeRobot's command, as far as the command describes them."""

    def __init__(self, config: VlagentsConfig, dataset_meta: Any) -> None:
        self.config = config
        features = {} if dataset_meta is None else dataset_meta.features
        self.names = _names(features.get("observation.state", {}).get("names"))
        self.action_names = _names(features.get("action", {}).get("names"))
        self.hz = None if dataset_meta is None else float(dataset_meta.fps)
        action = config.action_feature
        self.action_dim = None if action is None else int(action.shape[0])

    @property
    def is_timed(self) -> bool:
        """Whether the loop can miss ticks: it controls a robot, and its rate is known."""
        return self.hz is not None and self.config.priority == "robot"

    def ticks_in(self, waited_s: float) -> int:
        """Return the number of ticks that the loop misses while it waits, in addition to the
        waiting tick.
        """
        return int(waited_s * self.hz) if self.hz is not None and self.is_timed else 0

    def connect(self) -> RemoteAgent:
        """Return a connection to the server, after the server is ready."""
        config = self.config
        if not config.url:
            raise ConfigError(
                "policy.url: expected the server's URL, got none; set it, as "
                "--policy.url=http://gpu-box:8000"
            )
        certificate = (config.certificate[0], config.certificate[1]) if config.certificate else None
        agent = RemoteAgent(
            config.url,
            transport=cast(Any, config.transport),
            timeout_s=config.timeout_s,
            connect_timeout_s=config.connect_timeout_s,
            codec=cast(Any, config.codec),
            priority=cast(Any, config.priority),
            api_key=config.api_key,
            ca=config.ca,
            certificate=certificate,
        )
        agent.initialize()
        return agent

    def check_features(self, agent: RemoteAgent) -> None:
        """Compare the features that are known before the first observation; raises
        `ContractMismatch`.
        """
        shapes = shapes_of_features(self.config.input_features or {})
        if shapes:
            self.mapping(agent, shapes)
        rows = agent.contract.chunk if agent.contract else None
        if rows is not None and (self.config.n_action_steps or 0) > rows:
            raise ConfigError(
                f"policy.n_action_steps: expected at most {rows}, the rows of the server's "
                f"chunks, got {self.config.n_action_steps}"
            )

    def mapping(
        self, agent: RemoteAgent, shapes: Mapping[str, Sequence[int]]
    ) -> ObservationMapping:
        """Return the mapping from observations of these shapes to the policy's inputs; raises
        `ContractMismatch`.
        """
        found = ObservationMapping(self.config, agent.contract, shapes, self.names)
        require_fit(agent.contract, found.contract(self.action_dim, self.hz, self.action_names))
        return found

    def fit(self, agent: RemoteAgent, mapping: ObservationMapping) -> Fit:
        """Return the comparison of the policy's statistics with the robot's numbers; environments
        are not compared.
        """
        statistics = agent.statistics if self.config.priority == "robot" else None
        trained, parts = (
            Trained.from_statistics(statistics or {}),
            [*itertools.chain(*mapping.parts.values())],
        )
        names = tuple(part for part, _ in parts)
        return Fit(trained, None, tuple(self.action_names), names, self.config.ignore_mismatch)


class _Sessions:
    """The sessions of one thread: one for each row of its batches."""

    def __init__(self, robot: _Robot) -> None:
        self._robot, self._config = robot, robot.config
        self.agent = robot.connect()
        self._agents: list[RemoteAgent] = []
        self._rows: list[deque[np.ndarray]] = []
        # The mapping; None before the first episodes.
        self._mapping: ObservationMapping | None = None
        # Comparison of the next chunks with the robot; None once it has been made.
        self._fit: Fit | None = None
        self._due = True  # whether the next batch begins episodes
        self._begun = 0  # number of episodes so far
        # For each session: the ticks of LeRobot's loop since the last request, and the ticks that
        # it missed while it waited for a chunk.
        self._ticks: list[list[int]] = []

    def reset(self) -> None:
        """Begin episodes with the next batch; another thread may be running `chunks`."""
        self._due = True

    def next_rows(self, batch: Mapping[str, Any]) -> np.ndarray:
        """Return the next row of each session, (B, D) float32."""
        is_first = self._begin_if_due(batch)
        empty = [row for row, rows in enumerate(self._rows) if not rows]
        missed = 0
        if empty:
            reports = [] if is_first else [self._report(row) for row in empty]
            asked = time.monotonic()
            chunks = self._act(batch, empty, reports)
            waited_s = time.monotonic() - asked
            if not is_first:  # an episode begins with its first answer
                missed = self._robot.ticks_in(waited_s)
            for row, chunk in zip(empty, chunks, strict=True):
                self._rows[row].extend(chunk[: self._config.n_action_steps])

        for counts in self._ticks:
            counts[0] += 1 + missed
            counts[1] += missed
        return np.stack([rows.popleft() for rows in self._rows])

    def _report(self, row: int) -> dict[str, Any]:
        """Return the ticks since the session's last request, as the info of the next request;
        return nothing for simulations, and for loops whose rate is unknown.
        """
        if not self._robot.is_timed:
            return {}
        ticks, self._ticks[row] = self._ticks[row], [0, 0]
        return {TICKS: ticks}

    def chunks(self, batch: Mapping[str, Any], plans: Sequence[dict[str, Any]]) -> list[np.ndarray]:
        """Return a new chunk for each session, (H, D) float32 each, which continues the session's
        plan if there is one.
        """
        begun = self._begin_if_due(batch)
        return self._act(batch, range(len(self._agents)), () if begun else plans)

    def _begin_if_due(self, batch: Mapping[str, Any]) -> bool:
        """Begin episodes if they are due, and return whether they were."""
        size = _size(batch)
        if not self._due and size == len(self._agents):
            return False
        self._due = False
        try:
            self._begin(batch, size)
        except BaseException:
            self._due = True
            raise
        return True

    def _begin(self, batch: Mapping[str, Any], size: int) -> None:
        mapping = self._robot.mapping(self.agent, shapes_of_batch(batch))
        if mapping.unused and not self._begun:
            logger.info(
                "cameras that the policy does not use, and that are not sent: %s", mapping.unused
            )
        if size != len(self._agents):
            for agent in self._agents:
                agent.close()
            self._agents = self.agent.sessions(size)
        tasks = self._instructions(batch, size)
        seeds = (
            None
            if self._config.seed is None
            else [self._config.seed + self._begun + row for row in range(size)]
        )
        observations = [mapping.observation(batch, row) for row in range(size)]
        self._fit = fit = self._robot.fit(self.agent, mapping)
        for obs in observations:
            fit.require(obs, None)
        _successes(self.agent.reset_batch(observations, tasks, self._agents, seeds=seeds))
        self._begun += size
        self._rows = [deque() for _ in range(size)]
        self._ticks = [[0, 0] for _ in range(size)]
        self._mapping = mapping

    def _act(
        self, batch: Mapping[str, Any], rows: Sequence[int], infos: Sequence[dict[str, Any]] = ()
    ) -> list[np.ndarray]:
        mapping = cast(ObservationMapping, self._mapping)
        observations: list[Obs] = [mapping.observation(batch, row) for row in rows]
        for obs, info in zip(observations, infos, strict=False):
            obs.info.update(info)
        acts = cast(
            list[Act],
            _successes(self.agent.act_batch(observations, [self._agents[row] for row in rows])),
        )
        chunks = [act.rows().astype(np.float32, copy=False) for act in acts]
        want = self._robot.action_dim
        if odd := [chunk.shape[1] for chunk in chunks if want not in (None, chunk.shape[1])]:
            raise ContractMismatch(
                f"action: expected {want} numbers in each row, as this robot has, got {odd[0]} "
                f"from the server; check whether this is another robot's policy"
            )
        if self._fit is not None:
            for chunk in chunks:
                self._fit.require(None, chunk)
            self._fit = None
        return chunks

    def _instructions(self, batch: Mapping[str, Any], size: int) -> list[str | None]:
        task = batch.get("task") if self._config.instruction is None else self._config.instruction
        tasks = [task] * size if isinstance(task, str) else list(task or [None] * size)
        contract = self.agent.contract
        if contract is not None and contract.instruction and not all(tasks):
            raise ConfigError(
                "task: expected an instruction, as the policy needs one, got none; set "
                "--dataset.single_task, or --policy.instruction where the environment has none"
            )
        return [one or None for one in tasks]


def _size(batch: Mapping[str, Any]) -> int:
    return next(
        len(value)
        for key, value in batch.items()
        if key.startswith("observation.") and hasattr(value, "shape")
    )


def _plans(left: torch.Tensor | None, delay: int, size: int) -> list[dict[str, Any]]:
    """Return each session's `Obs.info` for real-time chunking, which is empty without a plan.

    LeRobot pads a plan with rows of zeros to the execution horizon. The rows of a plan are actions
    that are not normalised.
    """
    if left is None:
        return []
    plans = []
    for plan in left.detach().to("cpu", torch.float32).reshape(size, -1, left.shape[-1]).numpy():
        rows = plan[: np.flatnonzero(plan.any(axis=1)).max(initial=-1) + 1]
        plans.append({LEFTOVER: rows, DELAY: min(delay, len(rows))} if len(rows) else {})
    return plans


def _names(names: Any) -> list[str]:
    """Return the names of a feature's values. A dataset has them as a list, or as a mapping from
    groups to lists.
    """
    groups = names.values() if isinstance(names, Mapping) else [names or []]
    return [str(name) for group in groups for name in group]


def _successes(results: Sequence[Any]) -> list[Any]:
    """Return the results, or raise the first exception among them."""
    for result in results:
        if isinstance(result, Exception):
            raise result
    return list(results)
