"""Sessions with different LoRA adapters share one model, one load and one batch, but have different
identities.
"""

from __future__ import annotations

import queue
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from in_flight import checked
from numbered_checkpoints import begin

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.errors import ConfigError, UnknownCheckpoint
from vlagents_ray.interface import POLICY
from vlagents_ray.policies.adapters import ADAPTER
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.config.deployment import CheckpointArgs
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.settings import wrong_settings

CHOICES = {
    "stack": {"adapter": "/runs/stack"},
    "pour": {"adapter": "org/pour@main"},
    "late": {"checkpoint": "/runs/b"},
}


class Adapted(Agent):
    """A policy that returns the name of its session's adapter, like a family with adapters."""

    shared = ("made", "settings")

    def __init__(self, made: list[Adapted], settings: Mapping[str, Any]) -> None:
        self.made, self.settings = made, dict(settings)
        self.batches: list[list[str]] = []
        made.append(self)

    def initialize(self) -> None:
        self.weights_id = {"digest": f"whole:{self.settings['checkpoint']}", "revision": None}

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.adapter = kwargs.get(ADAPTER) or ""
        source = self.settings.get("adapters", {}).get(self.adapter)
        return {"checkpoint": source, "weights": f"with:{self.adapter}"} if self.adapter else {}

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        names = [session.adapter for session in sessions]  # type: ignore[attr-defined]
        self.batches.append(names)
        return [
            Act(np.zeros(1), info={POLICY: {"version": 0, "fingerprint": name}} if name else {})
            for name in names
        ]


@pytest.fixture
def made() -> list[Adapted]:
    """Return the list of all agents that are created."""
    return []


@pytest.fixture
def serve(made: list[Adapted]) -> Iterator[Callable[..., Engine]]:
    engines: list[Engine] = []

    def start(**options: Any) -> Engine:
        args = CheckpointArgs(choices=CHOICES, **options)
        source = args.of(lambda settings: Adapted(made, settings), {"checkpoint": "/runs/a"})
        engines.append(Engine(source))
        engines[-1].start()
        return engines[-1]

    yield start
    for engine in engines:
        engine.close()


def told(engine: Engine, session: str, **kwargs: Any) -> dict[str, Any]:
    """Reset a session, and return the info of the reply."""
    reply = begin(engine, session, **kwargs).get(timeout=120)
    if reply.error is not None:
        raise reply.error
    assert reply.info is not None
    return reply.info


def test_sessions_of_one_base_act_in_one_batch_and_say_what_acted(
    serve: Callable[..., Engine], made: list[Adapted]
) -> None:
    engine = serve()
    assert told(engine, "s0", checkpoint="stack") == {
        "checkpoint": "/runs/stack",
        "weights": "with:stack",
    }
    assert told(engine, "s1", checkpoint="pour") == {
        "checkpoint": "org/pour@main",
        "weights": "with:pour",
    }
    assert told(engine, "s2") == {"checkpoint": "/runs/a", "weights": "whole:/runs/a"}
    assert told(engine, "s3", checkpoint="late") == {
        "checkpoint": "/runs/b",
        "weights": "whole:/runs/b",
    }
    replies: list[queue.SimpleQueue[Reply]] = [queue.SimpleQueue() for _ in range(4)]
    engine.queue.put(
        *(checked(engine, f"s{i}", Request("act", Obs()), replies[i].put) for i in range(4))
    )
    acts = [one.get(timeout=120).act for one in replies]
    assert [one.info[POLICY]["fingerprint"] for one in acts if one is not None][:2] == [
        "stack",
        "pour",
    ]
    assert [agent.batches for agent in made] == [[["stack", "pour", ""]], [[""]]]


def test_adapters_are_settings_of_the_deployments_own_checkpoint_alone(
    serve: Callable[..., Engine], made: list[Adapted]
) -> None:
    engine = serve(steps=True)
    told(engine, "s3", checkpoint="late")
    told(engine, "s4", checkpoint_step=3)
    adapters = {"stack": "/runs/stack", "pour": "org/pour@main"}
    assert [agent.settings.get("adapters") for agent in made] == [adapters, None, None]
    described = engine.models.describe()
    assert described["choices"] == adapters | {"late": "/runs/b"}
    assert engine.models.config == {"checkpoint": "/runs/a", "adapters": adapters}


def test_a_swap_keeps_the_adapters(serve: Callable[..., Engine], made: list[Adapted]) -> None:
    engine = serve()
    engine.models.configure({"checkpoint": "/runs/a"})  # the checkpoint in use
    engine.models.configure({"checkpoint": "/runs/c"})
    while told(engine, "s0", checkpoint="stack") and len(made) < 2:
        pass
    assert [agent.settings["adapters"] for agent in made] == [
        {"stack": "/runs/stack", "pour": "org/pour@main"}
    ] * 2
    assert made[1].settings["checkpoint"] == "/runs/c"


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"checkpoint": "fold"}, r"expected one of \['late', 'pour', 'stack'\].*, got 'fold'"),
        (
            {"checkpoint": "stack", "checkpoint_step": 3},
            "expected none with the adapter 'stack', since an adapter has no steps, got 3",
        ),
        (
            {"checkpoint": "stack", "adapter": "pour"},
            "expected only one of these options, got 'pour' and 'stack'",
        ),
    ],
)
def test_what_is_not_offered_is_refused(
    serve: Callable[..., Engine], options: dict[str, Any], says: str
) -> None:
    with pytest.raises(UnknownCheckpoint, match=says):
        begin(serve(steps=True), "s", **options)


@pytest.mark.parametrize(
    "settings", [{"adapter": "/runs/stack", "checkpoint": "/runs/b"}, {"adapter": 3}]
)
def test_an_adapter_stands_alone(settings: dict[str, Any]) -> None:
    with pytest.raises(
        ValueError, match=r"stack: expected \{adapter: FOLDER or org/name@COMMIT\} alone, got .*"
    ) as error:
        CheckpointArgs(choices={"stack": settings})
    assert "choices" in str(wrong_settings(error.value, CheckpointArgs))


def of(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the policy settings that a deployment with adapters derives from `settings`."""
    return CheckpointArgs(choices=CHOICES).of(lambda _: Agent(), settings).config


def test_adapters_of_the_settings_stay_beside_those_of_the_deployment() -> None:
    both = of({"checkpoint": "/runs/a", "adapters": {"fold": "/runs/fold", "stack": "/runs/stack"}})
    assert both["adapters"] == {
        "fold": "/runs/fold",
        "stack": "/runs/stack",
        "pour": "org/pour@main",
    }
    with pytest.raises(
        ConfigError, match=r"got \['stack'\] both in the policy's settings and among"
    ):
        of({"checkpoint": "/runs/a", "adapters": {"stack": "/runs/other"}})
    with pytest.raises(
        ConfigError,
        match=r"adapters: expected a folder or a hub id for each name, got \['stack'\]",
    ):
        of({"checkpoint": "/runs/a", "adapters": ["stack"]})
