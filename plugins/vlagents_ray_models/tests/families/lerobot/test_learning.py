"""The outputs of SmolVLA for learners, and the shared observation of its samples."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from normal_steps import logprob_of_steps
from shared_readings import check_shared_readings

from plugins.vlagents_ray_models.tests.families.lerobot import tiny
from plugins.vlagents_ray_models.tests.families.lerobot.conftest import (
    FILTERS,
    Load,
    Made,
    begun,
    view,
)
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import BEHAVIOUR, DISTRIBUTION, SAMPLES, WANT, Act
from vlagents_ray.policies.base import Row
from vlagents_ray_models.lerobot import LeRobot, samplers

pytestmark = FILTERS

ALL = ["logprob", "entropy", "replay"]
LEVEL = 0.5
ATOL = 1e-5
SUMMED = 5e-3  # how far a sum of log-probabilities over the steps may be off, in float32


@pytest.fixture
def learnt(loaded: Load) -> LeRobot:
    return loaded("smolvla", noise_level=LEVEL)


def velocity(policy: LeRobot, number: int, noisy: Any, time: float) -> Any:
    """Return the flow's velocity (1, H, D) from LeRobot's own training pass, which has no
    cache.
    """
    session, network = begun(policy, number), policy.model.sampler.policy
    row = Row((session.perceive(view(number)),), session.episode.instruction, session.episode.rng)
    batch = network._prepare_batch(policy.model.processors.observe([row], 1))
    images, masks = network.prepare_images(batch)
    words = [batch[f"observation.language.{name}"] for name in ("tokens", "attention_mask")]
    outputs: list[Any] = []
    hook = network.model.action_out_proj.register_forward_hook(
        lambda _module, _inputs, output: outputs.append(output)
    )
    try:
        with torch.no_grad():  # between the same noise and actions, noisy actions are the same
            state, times = network.prepare_state(batch), torch.tensor([time])
            network.model.forward(images, masks, *words, state, noisy, noise=noisy, time=times)
    finally:
        hook.remove()
    return outputs[0]


def test_it_offers_what_random_steps_have(loaded: Load, learnt: LeRobot) -> None:
    assert loaded("smolvla").contract.behaviour is None
    assert learnt.contract.behaviour == tuple(ALL)


def test_a_policy_without_a_flow_has_no_noise_level(made: Made) -> None:
    with pytest.raises(ConfigError, match=r"noise_level: expected 0 for LeRobot's 'act'.*got 0\.5"):
        LeRobot.from_config({"checkpoint": str(made("act")), "noise_level": LEVEL}).initialize()


def test_the_log_probability_is_that_of_the_network_itself(learnt: LeRobot) -> None:
    act = begun(learnt, 1).act(view(1, **{WANT: ALL, SAMPLES: 2}))
    behaviour, samples = act.info[BEHAVIOUR], act.info[DISTRIBUTION]
    chains = [behaviour["replay"]["chain"], *samples["replay"]["chain"]]
    logprobs = [behaviour["logprob"], *samples["logprob"]]
    for chain, logprob in zip(chains, logprobs, strict=True):
        total = logprob_of_steps(lambda noisy, time: velocity(learnt, 1, noisy, time), chain, LEVEL)
        np.testing.assert_allclose(logprob, total[: len(act.action), : tiny.ACTION], atol=SUMMED)


def test_a_chain_ends_with_the_actions(learnt: LeRobot) -> None:
    act = begun(learnt, 1).act(view(1, **{WANT: ["replay"]}))
    chain = torch.from_numpy(act.info[BEHAVIOUR]["replay"]["chain"])
    actions = learnt.model.processors.actions(chain[-1:, :, : tiny.ACTION])[0]
    np.testing.assert_allclose(act.action, actions[: len(act.action)], atol=ATOL)


def test_neighbours_change_neither_what_is_drawn_nor_what_is_not(learnt: LeRobot) -> None:
    views = [view(0), view(1, **{WANT: ALL, SAMPLES: 2}), view(2, **{WANT: ALL})]
    together = learnt.act_batch(views, [begun(learnt, number) for number in range(3)])
    for number, act in enumerate(together):
        assert isinstance(act, Act)
        alone = begun(learnt, number).act(views[number])
        np.testing.assert_allclose(act.action, alone.action, atol=ATOL)
        if BEHAVIOUR in alone.info:
            np.testing.assert_allclose(
                act.info[BEHAVIOUR]["logprob"], alone.info[BEHAVIOUR]["logprob"], atol=SUMMED
            )


def test_the_samples_of_an_observation_are_of_one_reading_of_it(
    learnt: LeRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[int] = []
    model = learnt.model.sampler.policy.model
    embed = model.embed_prefix

    def count_and_embed(images: Any, *args: Any, **kwargs: Any) -> Any:
        read.append(len(images[0]))
        return embed(images, *args, **kwargs)

    monkeypatch.setattr(model, "embed_prefix", count_and_embed)
    views = [view(0, **{SAMPLES: 8, WANT: ALL}), view(1), view(2, **{SAMPLES: 3})]
    check_shared_readings(learnt, views, begun, samplers, ATOL)
    assert read == [3, 14]
