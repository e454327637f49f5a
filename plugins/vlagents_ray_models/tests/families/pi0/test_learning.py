"""The outputs of π0 for learners, the shared observation of its samples, and its compiled cores."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from counting_compiler import counting_compiler
from in_flight import answered
from normal_steps import logprob_of_steps
from pushed_weights import check_pushed_weights
from shared_readings import check_shared_readings

from plugins.vlagents_ray_models.tests.families.pi0 import tiny
from plugins.vlagents_ray_models.tests.families.pi0.conftest import (
    BATCHED,
    WORDS,
    begun,
    made,
    seen,
)
from vlagents_ray.interface import BEHAVIOUR, DELAY, DISTRIBUTION, LEFTOVER, SAMPLES, WANT, Act, Obs
from vlagents_ray.policies.flow import logprob_of_chain
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.python_env.child_agent import ChildAgent
from vlagents_ray.serve.python_env.child_main import Settings
from vlagents_ray.serve.python_env.child_process import ChildProgram
from vlagents_ray_learn import Publisher
from vlagents_ray_models import pi0
from vlagents_ray_models.pi0 import Pi0

ROOT = Path(__file__).parents[5]
ALL = ["logprob", "entropy", "replay"]
LEVEL = 0.5
# How far a sum of 25 log-probabilities may be off, in float32: each is of a step of about 0.1.
SUMMED = 2e-3


@pytest.fixture(scope="module")
def plain(folder: Path) -> Pi0:
    return made(folder)


@pytest.fixture(scope="module")
def learnt(folder: Path) -> Pi0:
    return made(folder, noise_level=LEVEL)


def encoded(policy: Pi0, *seeds: int) -> dict[str, Any]:
    """Return the model's inputs for the observations of sessions."""
    rows = []
    for seed in seeds:
        session = begun(policy, seed)
        session.observe(seen(seed))
        episode = session.episode
        rows.append(pi0.Row(tuple(episode.frames), episode.instruction, episode.rng))
    return dict(policy._inputs(rows))


def test_it_offers_what_random_steps_have(plain: Pi0, learnt: Pi0) -> None:
    assert plain.contract.behaviour is None
    assert learnt.contract.behaviour == tuple(ALL)


def test_the_log_probability_is_that_of_the_network_itself(learnt: Pi0) -> None:
    behaviour = begun(learnt, 0).act(seen(0, **{WANT: ALL})).info[BEHAVIOUR]
    chain = behaviour["replay"]["chain"]
    network, inputs = learnt.model.network, encoded(learnt, 0)

    def velocity(noisy: Any, time: float) -> Any:
        """Return the network's velocity, from one pass over images, words and actions without a
        cache.
        """
        with torch.no_grad():
            return network(**inputs, noise=noisy, timestep=torch.tensor([time])).logits

    total = logprob_of_steps(velocity, chain, LEVEL)[:, : tiny.ACTION_DIM]
    np.testing.assert_allclose(behaviour["logprob"], total, atol=SUMMED)
    entropy = normal_entropies(len(chain) - 1) * total.numel()
    assert behaviour["entropy"] == pytest.approx(entropy, rel=1e-5)


def normal_entropies(steps: int) -> float:
    """Return the sum of the entropies of a number's steps."""
    times = [1 - step / steps for step in range(steps)]
    stds = [LEVEL * (time / max(1 - time, 1 / steps) / steps) ** 0.5 for time in times]
    return float(sum(torch.distributions.Normal(0, std).entropy() for std in stds))


def test_a_learner_recomputes_the_log_probabilities_of_several_acts(learnt: Pi0) -> None:
    sessions = [begun(learnt, seed) for seed in range(3)]
    acts = learnt.act_batch([seen(seed, **{WANT: ALL}) for seed in range(3)], sessions)
    behaviours = [act.info[BEHAVIOUR] for act in acts if isinstance(act, Act)]
    chains = np.stack([behaviour["replay"]["chain"] for behaviour in behaviours])
    logprobs = np.stack([behaviour["logprob"] for behaviour in behaviours])
    noise_level = behaviours[0]["replay"]["noise_level"]
    with torch.no_grad():
        velocity = pi0.flow_velocity(learnt.model.network, encoded(learnt, 0, 1, 2), torch.float32)
        recomputed = logprob_of_chain(velocity, torch.from_numpy(chains), noise_level)
    np.testing.assert_allclose(recomputed[:, :, : tiny.ACTION_DIM], logprobs, atol=SUMMED)
    for act, chain in zip(acts, chains, strict=True):
        np.testing.assert_array_equal(act.action, learnt.model.actions(chain[-1]))


def test_a_log_probability_for_each_sample_and_for_the_rows_that_are_used(
    folder: Path, learnt: Pi0
) -> None:
    short = made(folder, noise_level=LEVEL, execute=4)
    act = begun(short, 0).act(seen(0, **{WANT: ALL, SAMPLES: 3}))
    samples = act.info[DISTRIBUTION]
    assert act.info[BEHAVIOUR]["logprob"].shape == act.action.shape == (4, tiny.ACTION_DIM)
    assert samples["logprob"].shape == samples["samples"].shape == (3, 4, tiny.ACTION_DIM)

    with torch.no_grad():
        velocity = pi0.flow_velocity(
            learnt.model.network, encoded(learnt, 0), torch.float32, [0, 0, 0]
        )
        chains = torch.from_numpy(samples["replay"]["chain"])
        recomputed = logprob_of_chain(velocity, chains, LEVEL)
    np.testing.assert_allclose(
        recomputed[:, :4, : tiny.ACTION_DIM], samples["logprob"], atol=SUMMED
    )


def test_the_samples_of_an_observation_are_of_one_reading_of_it(
    learnt: Pi0, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[int] = []
    embed = learnt.model.network.model.embed_prefix

    def count_and_embed(tokens: Any, *args: Any) -> Any:
        read.append(len(tokens))
        return embed(tokens, *args)

    monkeypatch.setattr(learnt.model.network.model, "embed_prefix", count_and_embed)
    views = [seen(0, **{SAMPLES: 8, WANT: ALL}), seen(1), seen(2, **{SAMPLES: 3})]
    check_shared_readings(learnt, views, begun, pi0, BATCHED)
    assert read == [3, 14]


SIZE = 3
NORMS = 2  # norms of a layer
# The rows of the tensor that each program reads first: one layer of the vision encoder, whose rows
# are images of two cameras, and one of the language model, which begins with the factors of its
# norms; of the steps, the embedding, one layer and the last norm.
PROGRAMS = [2 * SIZE, NORMS, SIZE, NORMS, SIZE]


@pytest.fixture(scope="module")
def programs() -> Iterator[list[int]]:
    """The rows of each program that is made."""
    with counting_compiler() as compiler:
        yield compiler.rows


@pytest.fixture(scope="module")
def compiled(folder: Path, programs: list[int]) -> Pi0:
    policy = made(folder, noise_level=LEVEL, compile="require", batch_sizes=[SIZE])
    assert programs == PROGRAMS
    return policy


def acts(policy: Pi0, views: list[Obs]) -> list[Act]:
    outcomes = policy.act_batch(views, [begun(policy, i) for i in range(len(views))])
    assert all(isinstance(outcome, Act) for outcome in outcomes)
    return outcomes  # type: ignore[return-value]


def test_batches_of_any_size_are_those_without_compilation(learnt: Pi0, compiled: Pi0) -> None:
    for size in (1, 2, SIZE, SIZE + 1):
        views = [seen(i) for i in range(size)]
        for expected, act in zip(acts(learnt, views), acts(compiled, views), strict=True):
            np.testing.assert_allclose(expected.action, act.action, atol=BATCHED)


def test_plans_samples_and_random_steps_are_those_without_compilation(
    learnt: Pi0, compiled: Pi0, programs: list[int]
) -> None:
    plan = np.ones((6, tiny.ACTION_DIM), np.float32)
    views = [
        seen(0, **{LEFTOVER: plan, DELAY: 2}),
        seen(1, **{SAMPLES: 2, WANT: ["logprob"]}),
    ]
    for pair in zip(acts(learnt, views), acts(compiled, views), strict=True):
        np.testing.assert_allclose(*(act.action for act in pair), atol=BATCHED)
        if DISTRIBUTION in pair[0].info:
            samples = [act.info[DISTRIBUTION]["samples"] for act in pair]
            np.testing.assert_allclose(*samples, atol=BATCHED)
            logprobs = [act.info[BEHAVIOUR]["logprob"] for act in pair]
            np.testing.assert_allclose(*logprobs, atol=2e-3)  # sums over steps of a tenth
    assert programs == PROGRAMS


def test_it_acts_with_pushed_weights(compiled: Pi0, programs: list[int]) -> None:
    check_pushed_weights(compiled, lambda: begun(compiled, 0).act(seen(0)).action)
    assert programs == PROGRAMS


def test_in_a_child_process_it_acts_with_pushed_weights(folder: Path) -> None:
    policy = made(folder)
    pushed = {}
    for name, value in policy.parameters().items():
        pushed[name] = 0.8 * value if value.is_floating_point() else value

    settings = Settings("pi0", {"checkpoint": str(folder)}, 1, "1")
    program = ChildProgram(sys.executable, settings, {"PYTHONPATH": str(ROOT)})
    served = Engine(ChildAgent(program))
    served.start()
    try:
        Publisher(served).push(pushed)
        answered(
            served,
            "a",
            Request("reset", seen(0), WORDS[0], kwargs={"seed": 0}, priority="simulation"),
        )
        act = answered(served, "a", Request("act", seen(0), priority="simulation")).act
    finally:
        served.close()
    before = begun(policy, 0).act(seen(0)).action
    policy.load_parameters(pushed)
    assert act.info["policy"]["version"] == 1
    np.testing.assert_allclose(act.action, begun(policy, 0).act(seen(0)).action, atol=BATCHED)
    assert np.abs(act.action - before).max() > 100 * BATCHED


@pytest.mark.parametrize("samples", [0, 2])
def test_nothing_is_compiled_in_service(compiled: Pi0, programs: list[int], samples: int) -> None:
    plan: dict[str, Any] = {LEFTOVER: np.ones((6, tiny.ACTION_DIM), np.float32), DELAY: 2}
    with torch.compiler.set_stance("fail_on_recompile"):
        for size in range(1, SIZE + 3):
            for info in ({}, plan, {WANT: ALL}):
                requested = info | ({SAMPLES: samples} if samples else {})
                views = [seen(i, **(requested if i % 2 == 0 else {})) for i in range(size)]
                acts(compiled, views)
    assert programs == PROGRAMS
