"""With `batch: {invariant: true}`, no bit of an action depends on its batch, or the policy is
rejected when it is loaded.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from batch_bits import ROBOTS, differing_acts, invariant
from pydantic import ValidationError

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.errors import PolicyFailed
from vlagents_ray.interface import DELAY, LEFTOVER, SAMPLES
from vlagents_ray.policies.base import ModelConfig, ModelPolicy, Prediction, Row, shared_frames
from vlagents_ray.policies.wrapper import Wrapper
from vlagents_ray.serve.config.deployment import BatchArgs, ServerArgs
from vlagents_ray.serve.local_agent import LocalPolicy

HORIZON, DIM, ROWS = 3, 2, 8


class Rounding(ModelPolicy):
    """A model whose result depends on the number of rows of a pass, as kernels are chosen by it."""

    Config = ModelConfig
    continues_plans = True

    @property
    def contract(self) -> Contract:
        return Contract(
            state={"joints": StateSpec(DIM)},
            action=ActionSpec(dim=DIM),
            chunk=self.chunk(HORIZON),
            history=1,
        )

    def load(self) -> list[int]:
        return []

    def perceive(self, obs: Obs) -> np.ndarray:
        return obs.state["joints"].copy()

    def error(self, rows: Sequence[Row], place: int) -> float:
        """Return the relative rounding error at a place of a pass."""
        firsts, _ = shared_frames(rows)
        return len(rows) + 0.1 * len(firsts)

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        self.model.append(len(rows))
        results: list[Prediction | Exception] = []
        for place, row in enumerate(rows):
            noisy = row.frames[-1] + row.noise(HORIZON, DIM)
            results.append(Prediction(noisy * np.float32(1 + 1e-6 * self.error(rows, place))))
        return results


class ByPlace(Rounding):
    """A model whose last rows are computed by another kernel."""

    def error(self, rows: Sequence[Row], place: int) -> float:
        return float(place >= len(rows) - 2)


class OnePlace(Rounding):
    """A model with another kernel in a single place."""

    def error(self, rows: Sequence[Row], place: int) -> float:
        return float(place == 3)


class ByNeighbours(Rounding):
    """A model whose result depends on the other rows, as with prompts padded to the longest."""

    def error(self, rows: Sequence[Row], place: int) -> float:
        return float(max(row.frames[-1][0] for row in rows))


class BySomePlan(Rounding):
    """A model that computes a whole pass in another way if any row continues a plan."""

    def error(self, rows: Sequence[Row], place: int) -> float:
        return float(any(row.leftover is not None for row in rows))


class Declared(Rounding):
    """A model whose family states that its passes depend on their rows."""

    variation = "its prompts are padded to the longest"


def plain(robot: int, tick: int) -> Obs:
    return Obs(state={"joints": np.array([robot, tick], np.float32)})


def varied(robot: int, tick: int) -> Obs:
    """Return an observation; some request samples, and some continue a plan."""
    obs = plain(robot, tick)
    if (robot + tick) % 3 == 1:
        obs.info[SAMPLES] = 1 + robot % 4
    if (robot + tick) % 3 == 2:
        obs.info.update({LEFTOVER: np.zeros((2, DIM), np.float32), DELAY: 1})
    return obs


def loaded(cls: type[ModelPolicy], rows: int = ROWS, **config: Any) -> tuple[ModelPolicy, Any]:
    """Return a policy that was loaded as with `invariant`, and the reason why it is rejected."""
    policy = cls.from_config({"checkpoint": "none", **config})
    with invariant(rows) as report:
        policy.initialize()
    return policy, report.variation


def search(policy: ModelPolicy, observe: Callable[[int, int], Obs]) -> tuple[int, list[str]]:
    def begin(robot: int) -> Agent:
        session = copy.copy(policy)
        session.reset(observe(robot, 0), "go", seed=robot)
        return session

    return differing_acts(policy, begin, observe, ticks=6, rounds=6)


@pytest.mark.parametrize("rows", [1, 2, 5, ROWS, 16])
@pytest.mark.parametrize("actions", ["chunk", "queue", "ensemble"])
def test_no_bit_depends_on_the_batch(rows: int, actions: str) -> None:
    policy, variation = loaded(Rounding, rows, actions=actions)
    assert variation is None
    # Only whole chunks have samples.
    compared, differing = search(policy, varied if actions == "chunk" else plain)
    assert compared == 6 * 6 * ROBOTS
    assert differing == []
    assert set(policy.model) == {rows}


def test_without_it_bits_depend_on_the_batch() -> None:
    for sizes in (None, [ROWS]):  # fixed sizes alone do not suffice, since samples share views
        policy = Rounding.from_config({"checkpoint": "none", "batch_sizes": sizes})
        policy.initialize()
        assert search(policy, varied)[1]


@pytest.mark.parametrize(
    ("cls", "reason"),
    [
        (ByPlace, "the bits of a row depend on its place: they differ at 2 of 8 places"),
        (OnePlace, "the bits of a row depend on its place: they differ at 2 of 8 places"),
        (ByNeighbours, "the bits of a row depend on the other rows"),
        (BySomePlan, "the bits of a row depend on the other rows"),
        (Declared, "its prompts are padded to the longest"),
    ],
)
def test_a_model_that_varies_is_found(cls: type[ModelPolicy], reason: str) -> None:
    assert reason in loaded(cls)[1]


@pytest.mark.parametrize("place", range(ROWS))
def test_every_place_is_compared(place: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(OnePlace, "error", lambda _self, _rows, i: float(i == place))
    assert "its place" in loaded(OnePlace)[1]


def test_the_policy_may_not_have_other_sizes() -> None:
    _, variation = loaded(Rounding, batch_sizes=[4, 8])
    assert variation == "its batch_sizes are [4, 8], and batch.max_size is 8"


class Alone(Agent):
    """A policy that computes each session by itself."""

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(DIM, np.float32))


class Together(Alone):
    """A policy of which the server does not know how it computes a batch."""

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        return [self.act(session_obs) for session_obs in obs]


class Tracks(Wrapper):
    """A wrapper that changes the observations of a batch together."""

    def change_batch(
        self, obs: Sequence[Obs], sessions: Sequence[Wrapper]
    ) -> list[Obs | Exception]:
        return list(obs)


class Shifts(Tracks):
    """A wrapper that changes each observation by itself."""

    repeatable = True


def passes(policy: str, *wrappers: str, **batch: Any) -> dict[str, Any]:
    """Load a policy as a replica does, and return what its metadata says of its passes."""
    config = {} if policy in ("Alone", "Together") else {"checkpoint": "none"}
    args = ServerArgs(
        policy=f"{__name__}:{policy}",
        config=config,
        wrappers=[f"{__name__}:{wrapper}" for wrapper in wrappers],
        batch={"max_size": ROWS, **batch},
    )
    with LocalPolicy(args, config) as agent:
        agent.initialize()
        described: dict[str, Any] = agent.metadata["passes"]
        return described


@pytest.mark.parametrize("wrappers", [(), ("Shifts",)])
@pytest.mark.parametrize("policy", ["Rounding", "Alone"])
def test_a_server_says_how_many_rows_a_pass_has(policy: str, wrappers: tuple[str, ...]) -> None:
    assert passes(policy, *wrappers, invariant=True) == {"invariant": True, "rows": ROWS}
    assert passes(policy, *wrappers, invariant="auto") == {"invariant": True, "rows": ROWS}
    assert passes(policy, *wrappers) == {"invariant": False}


@pytest.mark.parametrize(
    ("policy", "wrappers", "reason"),
    [
        ("ByPlace", (), "depend on its place"),
        ("Together", (), "Together.act_batch computes a batch in a way that the server does not"),
        ("Alone", ("Tracks",), "Tracks changes the observations of a batch together"),
    ],
)
def test_a_server_rejects_a_policy_that_varies(
    policy: str, wrappers: tuple[str, ...], reason: str
) -> None:
    with pytest.raises(PolicyFailed, match=rf"got one that may: .*{reason}.*set batch.max_size to"):
        passes(policy, *wrappers, invariant=True)
    assert passes(policy, *wrappers, invariant="auto") == {"invariant": False}
    one = {"max_size": 1, "invariant": True}
    assert passes(policy, *wrappers, **one) == {"invariant": True, "rows": 1}


def test_it_has_one_size() -> None:
    with pytest.raises(ValidationError, match="expected none with `invariant`, whose only size"):
        BatchArgs(sizes=[4, 8], invariant=True)
