"""A policy that is a model: sessions, history, chunks and samples around one forward pass."""

from __future__ import annotations

import abc
import copy
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.client.plan import ENSEMBLE, Chunk, Plan
from vlagents_ray.contract import Contract, check_action
from vlagents_ray.errors import InvalidAction, InvalidObservation, NotReset, PolicyFailed
from vlagents_ray.interface import DELAY, DISTRIBUTION, LEFTOVER, Act, Agent, Obs
from vlagents_ray.policies.base.config import ModelConfig
from vlagents_ray.policies.base.observing import count_in, leftover_plan, wanted_samples
from vlagents_ray.policies.base.row import Prediction, Row


@dataclass(slots=True)
class Episode:
    """What a session has of its own."""

    instruction: str
    frames: deque[Any]  # of `perceive`, oldest first
    rng: np.random.Generator
    draws: np.random.Generator  # of samples, so that asking for them changes no action
    plan: Plan  # chunks by tick, where they are averaged
    rows: deque[np.ndarray] = field(default_factory=deque)  # (D,) each, still to be returned
    tick: int = 0
    memory: dict[str, Any] = field(default_factory=dict)


class ModelPolicy(Agent, abc.ABC):
    """Base of the model families. A family defines `load`, `perceive` and `predict`, and its contract.

    The model is asked for one row an observation, all sessions of a batch in one forward pass of at most
    `config.rows`; a session's noise comes from its own generator, seeded by the config's seed and the episode's.
    """

    shared: ClassVar[tuple[str, ...]] = ("config", "model")

    def __init__(self, config: Any) -> None:
        self.config: ModelConfig = config
        self.model: Any = None
        self.episode: Episode | None = None

    @property
    def history(self) -> int:
        """Observations that `predict` gets of each session, at most."""
        return 1

    @property
    def state_dim(self) -> int | None:
        """Numbers of the model's state vector, once loaded; to warm up where its parts may be of any length."""
        return None

    def chunk(self, horizon: int) -> int:
        """For the contract: how many of the model's `horizon` rows an `act` returns."""
        return min(self.config.execute or horizon, horizon) if self.config.actions == "chunk" else 1

    @abc.abstractmethod
    def load(self) -> Any:
        """Read the checkpoint; what is returned becomes `self.model`, shared by all sessions."""

    @abc.abstractmethod
    def perceive(self, obs: Obs) -> Any:
        """What is kept of an observation: converted and resized, and no view of its memory, which is given back.

        An error that it raises fails the request of that session alone.
        """

    @abc.abstractmethod
    def predict(self, rows: Sequence[Row]) -> Sequence[Prediction | Exception]:
        """One chunk a row, all in one forward pass. A row's result must not depend on the others."""

    def initialize(self) -> None:
        """Load the checkpoint; with `batch_sizes`, run each of them once."""
        self.model = self.load()
        for size in self.config.batch_sizes or ():
            for prediction in self._forward([self._example() for _ in range(size)]):
                if isinstance(prediction, Exception):
                    raise prediction

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin the episode of `kwargs["seed"]` (an int, 0 if not given)."""
        contract = self.contract
        if contract is not None and contract.instruction and not instruction:
            raise InvalidObservation("instruction: got none, want what the robot is to do, in words")
        # numpy takes no negative seed; each int64 has its own number modulo 2**64
        seed = [self.config.seed, int(kwargs.get("seed") or 0) % 2**64]
        self.episode = Episode(
            instruction or "",
            deque(maxlen=self.history),
            np.random.default_rng(seed),
            np.random.default_rng([*seed, 1]),
            Plan(ENSEMBLE, self.config.ensemble_m),
        )
        self.notice(obs)
        return {}

    def notice(self, obs: Obs) -> None:
        """Take into the session's memory what has to be known of every observation, also where no chunk is wanted."""

    def observe(self, obs: Obs) -> None:
        """Add an observation to the history."""
        self.notice(obs)
        self._begun().frames.append(self.perceive(obs))

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """A chunk (H, D), or one action (D,), as `config.actions` says, for each session.

        One forward pass serves all that need the model at this tick.
        """
        results: list[Act | Exception | None] = [None] * len(obs)
        rows: list[Row] = []
        owners: list[int] = []
        for i, (one, session) in enumerate(zip(obs, sessions, strict=True)):
            try:
                wanted = self._rows(one, session)  # type: ignore[arg-type]
            except Exception as error:  # noqa: BLE001 - handed to the session whose request failed
                results[i] = error
                continue
            rows += wanted
            owners += [i] * len(wanted)
        predictions: list[list[Prediction | Exception]] = [[] for _ in obs]
        for i, prediction in zip(owners, self._forward(rows), strict=True):
            predictions[i].append(prediction)
        return [
            done if done is not None else self._act(session, found)  # type: ignore[arg-type]
            for done, session, found in zip(results, sessions, predictions, strict=True)
        ]

    def close(self) -> None:
        """Let go of the weights."""
        self.model = None

    def _begun(self) -> Episode:
        if self.episode is None:
            raise NotReset(f"{type(self).__name__}: act before reset; call reset(obs, instruction) first")
        return self.episode

    def _rows(self, obs: Obs, session: ModelPolicy) -> list[Row]:
        """What the model is asked for this session: nothing while rows are left, else its chunk, then its samples."""
        episode = session._begun()
        samples = wanted_samples(obs, self.config)
        session.notice(obs)
        if episode.rows and self.history == 1:
            return []
        episode.frames.append(self.perceive(obs))
        if episode.rows:
            return []
        own = Row(
            frames=tuple(episode.frames),
            instruction=episode.instruction,
            rng=episode.rng,
            leftover=None if obs.info.get(LEFTOVER) is None else leftover_plan(obs, self.contract),
            delay=count_in(obs, DELAY),
            info=obs.info,
            memory=episode.memory,
        )
        if not samples:
            return [own]
        return [own, *(_sample(own, episode.draws) for _ in range(samples))]

    def _act(self, session: ModelPolicy, found: list[Prediction | Exception]) -> Act | Exception:
        episode = session._begun()
        if not found:
            return self._next(episode, {})
        if (error := next((p for p in found if isinstance(p, Exception)), None)) is not None:
            return error
        own, *samples = found
        chunk = self._used(own.actions)  # type: ignore[union-attr]
        info: dict[str, Any] = dict(own.info)  # type: ignore[union-attr]
        if samples:
            info[DISTRIBUTION] = self._distribution(own, samples)  # type: ignore[arg-type]
        if self.config.actions == "chunk":
            episode.tick += 1
            return Act(chunk, info=info)
        try:  # before it is kept for later ticks
            check_action(chunk, self.contract)
        except InvalidAction as broken:
            return broken
        if self.config.actions == "queue":
            episode.rows.extend(chunk)
            return self._next(episode, info)
        episode.plan.add(Chunk(episode.tick, episode.tick, chunk, done=False, info={}), episode.tick)
        step = episode.plan.at(episode.tick)
        if step is None:
            return PolicyFailed("ensemble: no chunk covers this tick")
        episode.tick += 1
        return Act(step.action, info=info)

    def _next(self, episode: Episode, info: dict[str, Any]) -> Act:
        episode.tick += 1
        return Act(episode.rows.popleft(), info=info)

    def _used(self, actions: np.ndarray) -> np.ndarray:
        """The rows of a chunk that are used, (execute, D)."""
        return np.ascontiguousarray(actions[: self.config.execute], dtype=np.float32)

    def _distribution(self, own: Prediction, samples: list[Prediction]) -> dict[str, np.ndarray]:
        drawn = np.stack([self._used(sample.actions) for sample in samples])
        mean = drawn.mean(0) if own.mean is None else self._used(own.mean)
        std = drawn.std(0) if own.std is None else self._used(own.std)
        return {"mean": mean, "std": std, "samples": drawn}

    def _forward(self, rows: list[Row]) -> list[Prediction | Exception]:
        """All rows, in forward passes of the sizes that the config allows."""
        found: list[Prediction | Exception] = []
        most = self.config.rows
        for start in range(0, len(rows), most):
            part = rows[start : start + most]
            size = next((s for s in self.config.batch_sizes or () if s >= len(part)), len(part))
            padding = [copy.deepcopy(part[-1]) for _ in range(size - len(part))]
            results = self.predict([*part, *padding])
            if len(results) != size:
                raise PolicyFailed(f"predict: got {size} rows, returned {len(results)} chunks")
            found += results[: len(part)]
        return found

    def _example(self) -> Row:
        """A row to warm up with: black images and zeros, as the contract wants them."""
        contract = self.contract or Contract()
        lengths = {name: part.dim or 1 for name, part in (contract.state or {}).items()}
        unstated = [name for name, part in (contract.state or {}).items() if part.dim is None]
        if unstated and self.state_dim is not None:
            lengths[unstated[0]] += self.state_dim - len(unstated) - bool(contract.gripper)
        obs = Obs(
            cameras={
                name: np.zeros((one.height or 224, one.width or 224, 3), np.uint8)
                for name, one in (contract.cameras or {}).items()
            },
            gripper=1.0,
            state={name: np.zeros(length, np.float32) for name, length in lengths.items()},
        )
        return Row((self.perceive(obs),) * self.history, "warm up", np.random.default_rng(0))


def _sample(row: Row, draws: np.random.Generator) -> Row:
    """The same row, with noise and memory that are not the session's."""
    return replace(row, rng=draws, memory=copy.deepcopy(row.memory), sample=True)
