"""A learner that trains one adapter pushes only its values; all other actions stay
bit-identical.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adapted_network import DIM, LAYERS, Small, base, pairs, save
from gain_policies import in_child
from in_flight import answered
from pushed_weights import push

from vlagents_ray import Agent, Obs
from vlagents_ray.errors import InvalidWeights
from vlagents_ray.interface import Act
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.weights import PushOptions, Rest
from vlagents_ray.weights import trainable
from vlagents_ray.weights.trainable import fingerprint

pytestmark = pytest.mark.torch

RANKS = {"stack": 4, "pour": 2}
A = "stack/base_model.model.see.lora_A.weight"


@pytest.fixture
def values(tmp_path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Return the saved values of each adapter, and under "trained" the values of "stack" after
    training.
    """
    network = made(tmp_path).model
    found = {name: pairs(network, LAYERS, rank, seed=rank) for name, rank in RANKS.items()}
    found["trained"] = pairs(network, LAYERS, RANKS["stack"], seed=9)
    for name, one in found.items():
        save(tmp_path / name, one)
    return found


def settings(tmp_path: Path, **adapters: str) -> dict[str, Any]:
    named = {name: str(tmp_path / folder) for name, folder in adapters.items()}
    return {"checkpoint": str(base(tmp_path)), "adapters": named}


def made(tmp_path: Path, **adapters: str) -> Small:
    policy = Small.from_config(settings(tmp_path, **adapters))
    policy.initialize()
    return policy


@pytest.fixture
def serving() -> Iterator[Callable[[Agent], Engine]]:
    engines: list[Engine] = []

    def serve(agent: Agent) -> Engine:
        engines.append(Engine(agent))
        engines[-1].start()
        return engines[-1]

    yield serve
    for engine in engines:
        engine.close()


def pushed(values: dict[str, np.ndarray], name: str = "stack") -> dict[str, np.ndarray]:
    return {f"{name}/{key}": value for key, value in values.items()}


def at(seed: int) -> Obs:
    return Obs(state={"joints": np.random.default_rng(seed).normal(size=DIM).astype(np.float32)})


def reset(engine: Engine, name: str | None) -> None:
    kwargs = {"seed": 3} | ({} if name is None else {"adapter": name})
    reply = answered(
        engine, str(name), Request("reset", at(0), None, kwargs, priority="simulation")
    )
    assert reply.error is None, reply.error


def act(engine: Engine, name: str | None) -> Act:
    reply = answered(engine, str(name), Request("act", at(1), priority="simulation"))
    assert reply.act is not None, reply.error
    return reply.act


def played(engine: Engine) -> dict[str | None, tuple[bytes, dict[str, Any]]]:
    """Return the first action of an episode with each adapter and without one, with the reported
    weights.
    """
    found = {}
    for name in ("stack", "pour", None):
        reset(engine, name)
        first = act(engine, name)
        found[name] = first.action.tobytes(), first.info["policy"]
    return found


@pytest.mark.parametrize("process", ["own", "child"])
def test_a_pushed_adapter_acts_as_the_saved_one_and_all_else_as_before(
    tmp_path: Path,
    values: dict[str, dict[str, np.ndarray]],
    serving: Callable[[Agent], Engine],
    process: str,
) -> None:
    config = settings(tmp_path, stack="stack", pour="pour")
    engine = serving(
        in_child("adapted_network:Small", **config)
        if process == "child"
        else Small.from_config(config)
    )
    before = played(engine)
    assert push(engine, pushed(values["trained"]), partial=True) == 1
    after, saved = (
        played(engine),
        played(serving(Small.from_config(settings(tmp_path, stack="trained", pour="pour")))),
    )
    assert before["stack"][0] != saved["stack"][0]
    assert {name: action for name, (action, _) in after.items()} == {
        name: action for name, (action, _) in saved.items()
    }
    assert after[None] == before[None], "the base's weights must not be replaced"
    assert [after[name][0] for name in ("pour", None)] == [
        before[name][0] for name in ("pour", None)
    ]
    whole = {
        name: np.asarray(value)
        for name, value in (pushed(values["trained"]) | pushed(values["pour"], "pour")).items()
    }
    named = {"version": 1, "fingerprint": fingerprint(whole)}
    assert [after[name][1] for name in ("stack", "pour")] == [named, named]
    assert push(engine, pushed(values["stack"]) | pushed(values["pour"], "pour")) == 2
    assert {name: action for name, (action, _) in played(engine).items()} == {
        name: one for name, (one, _) in before.items()
    }


def test_a_replica_that_starts_later_states_and_does_the_same(
    tmp_path: Path, values: dict[str, dict[str, np.ndarray]], serving: Callable[[Agent], Engine]
) -> None:
    engines = [
        serving(Small.from_config(settings(tmp_path, stack="stack", pour="pour"))) for _ in range(2)
    ]
    # The state at the beginning of a training.
    push(engines[0], pushed(values["stack"]), partial=True, allow_same=True)
    [held] = [one for one in engines[0].weights.pushed_versions() if one.number]
    engines[1].weights.stage(held.number, held.values, PushOptions(allow_same=True))
    engines[1].weights.commit(held.number, PushOptions())
    assert played(engines[0]) == played(engines[1])
    assert played(engines[0])["pour"][1]["version"] == 1


def test_sessions_of_two_versions_keep_theirs_until_their_reset(
    tmp_path: Path, values: dict[str, dict[str, np.ndarray]], serving: Callable[[Agent], Engine]
) -> None:
    engines = [
        serving(Small.from_config(settings(tmp_path, stack="stack", pour="pour"))) for _ in range(2)
    ]
    for engine in engines:
        reset(engine, "stack")
    pushing, still = engines
    push(pushing, pushed(values["trained"]), partial=True)
    reset(pushing, "pour")  # makes this version the agent's
    acts = [act(engine, "stack") for engine in engines]
    assert acts[0].action.tobytes() == acts[1].action.tobytes()
    assert acts[0].info["policy"] == acts[1].info["policy"]
    push(pushing, pushed(values["pour"], "pour"), mode="keep", partial=True, allow_same=True)
    assert act(pushing, "stack").info["policy"]["version"] == 2
    assert act(still, "stack").info["policy"]["version"] == 0


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            {"stack/base_model.model.head.1.lora_A.weight": np.ones((4, 8), np.float32)},
            "expected one of the policy's",
        ),
        (
            {"see.weight": np.ones((8, 4), np.float32)},
            "'see.weight': expected one of the policy's 16 names",
        ),
        ({A: np.ones((8, DIM), np.float32)}, rf"'{A}': expected shape \(4, 4\), got \(8, 4\)"),
        ({A: np.full((4, DIM), np.nan, np.float32)}, "expected finite values, got NaN or infinity"),
        ({A: np.ones((4, DIM), np.int64)}, "expected float32, got int64"),
    ],
)
def test_values_that_do_not_fit_change_nothing(
    tmp_path: Path,
    values: dict[str, dict[str, np.ndarray]],
    serving: Callable[[Agent], Engine],
    change: dict[str, np.ndarray],
    says: str,
) -> None:
    engine = serving(Small.from_config(settings(tmp_path, stack="stack", pour="pour")))
    before = played(engine)
    with pytest.raises(InvalidWeights, match=says):
        push(engine, pushed(values["trained"]) | change, partial=True)
    assert played(engine) == before


def test_two_names_of_one_folder_are_one_adapter(
    tmp_path: Path, values: dict[str, dict[str, np.ndarray]], serving: Callable[[Agent], Engine]
) -> None:
    engine = serving(Small.from_config(settings(tmp_path, stack="stack", pour="stack")))
    before = played(engine)
    push(engine, pushed(values["trained"]), partial=True)
    after = played(engine)
    assert after["stack"] == after["pour"] != before["pour"]


def test_a_transposed_view_is_pushed_by_its_values(
    tmp_path: Path, values: dict[str, dict[str, np.ndarray]], serving: Callable[[Agent], Engine]
) -> None:
    import torch

    engines = [
        serving(Small.from_config(settings(tmp_path, stack="stack", pour="pour"))) for _ in range(2)
    ]
    views = {
        name: torch.from_numpy(value.T.copy()).permute(*reversed(range(value.ndim)))
        for name, value in pushed(values["trained"]).items()
    }
    for engine, one in zip(engines, (views, pushed(values["trained"])), strict=True):
        push(engine, one, partial=True)
    assert played(engines[0]) == played(engines[1])


def test_the_base_and_its_adapters_sleep_and_wake(
    tmp_path: Path,
    values: dict[str, dict[str, np.ndarray]],
    serving: Callable[[Agent], Engine],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(trainable, "_on_gpu", lambda _: True)  # the CPU takes the place of a GPU
    policy = Small.from_config(settings(tmp_path, stack="stack", pour="pour"))
    engine = serving(policy)
    before = played(engine)
    memories = [one.untyped_storage() for one in policy.model.state_dict().values()]
    engine.weights.rest(Rest("sleep"))
    assert not any(memory.nbytes() for memory in memories)
    engine.weights.rest(Rest("wake"))
    assert played(engine) == before
