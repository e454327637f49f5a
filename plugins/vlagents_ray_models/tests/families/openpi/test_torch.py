"""openpi's PyTorch port, which needs a transformers that is patched as openpi describes; without
the patch it is rejected.
"""

from __future__ import annotations

import copy
import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from counting_compiler import counting_compiler
from normal_steps import logprob_of_steps
from pushed_weights import check_pushed_weights
from recorded_programs import recorded_programs
from rounding_errors import check_rounding

from plugins.vlagents_ray_models.tests.families.openpi.conftest import MARKS
from plugins.vlagents_ray_models.tests.families.openpi.test_openpi import (
    BATCHED,
    WORDS,
    begun,
    seen,
    theirs,
)
from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.interface import BEHAVIOUR, DELAY, DISTRIBUTION, LEFTOVER, SAMPLES, WANT
from vlagents_ray.policies.base import policy as base_policy
from vlagents_ray_models.openpi import OpenPi, _observation

pytestmark = MARKS
PATCHED = all(
    importlib.util.find_spec(name) for name in ("transformers", "transformers.models.siglip.check")
)
patched = pytest.mark.skipif(
    not PATCHED,
    reason="openpi's `transformers_replace` was not copied over transformers",
)


KINDS = ("pi0", "pi05")


@pytest.fixture(scope="module")
def ports(tiny: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Write a checkpoint of the port of each kind, as small as that of the JAX model."""
    return {kind: tiny.save_torch(tmp_path_factory.mktemp(kind), kind) for kind in KINDS}


@pytest.fixture(scope="module")
def port(ports: dict[str, Path]) -> Path:
    return ports["pi0"]


def made(folder: Path, kind: str = "pi0", **settings: Any) -> OpenPi:
    config = {
        "checkpoint": str(folder),
        "config": f"plugins.vlagents_ray_models.tests.families.openpi.tiny:{kind.upper()}",
        "steps": 3,
        **settings,
    }
    policy = OpenPi.from_config(config)
    policy.initialize()
    return policy


@patched
@pytest.mark.verifies("parity")
@pytest.mark.parametrize("kind", KINDS)
def test_actions_are_those_of_openpis_own_policy_alone_and_in_company(
    kind: str, ports: dict[str, Path]
) -> None:
    import torch
    from openpi.policies.policy import Policy

    policy = made(ports[kind], kind)
    transforms = policy.model.transforms
    upstream = Policy(
        policy.model.model.trained,
        transforms=transforms.inputs.transforms,
        output_transforms=transforms.outputs.transforms,
        sample_kwargs={"num_steps": 3},
        is_pytorch=True,
    )
    acts = policy.act_batch(
        [seen(kind, i) for i in range(3)], [begun(policy, kind, i) for i in range(3)]
    )
    for i, act in enumerate(acts):
        noise = np.random.default_rng([0, i]).standard_normal(
            policy.model.model.noise_shape, dtype=np.float32
        )
        with torch.inference_mode():
            theirs_obs = {**theirs(kind, i), "prompt": WORDS[i]}
            expected = upstream.infer(theirs_obs, noise=noise)["actions"]
        np.testing.assert_allclose(act.action, expected, atol=10 * BATCHED)


@patched
@pytest.mark.verifies("parity")
@pytest.mark.parametrize("kind", KINDS)
def test_in_bfloat16_the_error_is_that_of_openpis_own_passes(
    kind: str, ports: dict[str, Path]
) -> None:
    import torch
    from openpi.policies.policy import Policy

    policy, exact_policy = made(ports[kind], kind, dtype="bfloat16"), made(ports[kind], kind)
    network, exact_network = (loaded.model.model.trained for loaded in (policy, exact_policy))
    exact_network.load_state_dict(network.state_dict())  # with the same rounded weights
    transforms = policy.model.transforms

    def actions_of(network: Any, i: int) -> np.ndarray:
        """Return the actions by openpi's own passes."""
        upstream = Policy(
            network,
            transforms=transforms.inputs.transforms,
            output_transforms=transforms.outputs.transforms,
            sample_kwargs={"num_steps": 3},
            is_pytorch=True,
        )
        shape = policy.model.model.noise_shape
        noise = np.random.default_rng([0, i]).standard_normal(shape, dtype=np.float32)
        with torch.inference_mode():
            actions = upstream.infer({**theirs(kind, i), "prompt": WORDS[i]}, noise=noise)
        return np.asarray(actions["actions"])

    numbers = range(len(WORDS))
    acts = policy.act_batch(
        [seen(kind, i) for i in numbers], [begun(policy, kind, i) for i in numbers]
    )
    ours = np.stack([act.action for act in acts])
    theirs_rounded = np.stack([actions_of(network, i) for i in numbers])
    exact = np.stack([actions_of(exact_network, i) for i in numbers])
    check_rounding(ours, theirs_rounded, exact)


# Rows of the programs: one layer of the vision encoder, for three cameras, and one of the language
# model; of the steps, π0's embedding, one layer and the last norm.
PROGRAMS = {"pi0": [6, 2, 2, 2, 2], "pi05": [6, 2, 2, 2]}


@patched
@pytest.mark.parametrize("kind", KINDS)
def test_compiled_passes_act_as_without(kind: str, ports: dict[str, Path]) -> None:
    plain = made(ports[kind], kind)
    with counting_compiler() as programs:
        compiled = made(ports[kind], kind, compile="require", batch_sizes=[2])
        assert programs.rows == PROGRAMS[kind]

        def act(policy: OpenPi, size: int) -> list[Any]:
            views = [seen(kind, i) for i in range(size)]
            return policy.act_batch(views, [begun(policy, kind, i) for i in range(size)])

        for size in (1, 2, 3):
            for expected, result in zip(act(plain, size), act(compiled, size), strict=True):
                np.testing.assert_allclose(result.action, expected.action, atol=BATCHED)
        assert programs.rows == PROGRAMS[kind]


@patched
@pytest.mark.parametrize("kind", KINDS)
def test_flex_attention_acts_as_the_usual_one(
    kind: str, ports: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = made(ports[kind], kind)
    with recorded_programs(monkeypatch) as programs:
        policy = made(ports[kind], kind, attention="flex", compile="require", batch_sizes=[1])
        action = begun(policy, kind, 0).act(seen(kind, 0)).action
    counts = [calls.count("flex_attention") for calls in programs]
    assert sorted(counts) == [0] * (len(PROGRAMS[kind]) - 1) + [
        1
    ]  # of the layer of the steps alone
    expected = begun(plain, kind, 0).act(seen(kind, 0)).action
    np.testing.assert_allclose(action, expected, atol=BATCHED)


# Parts of the names of weights: of all, and of those that are read once for a flow.
@patched
@pytest.mark.parametrize(
    ("kind", "part"),
    [
        ("pi0", ""),
        ("pi0", "layernorm.weight"),
        ("pi05", ""),
        ("pi05", "layernorm.dense"),
        ("pi05", "time_mlp_in"),
    ],
)
def test_it_acts_with_pushed_weights(kind: str, part: str, ports: dict[str, Path]) -> None:
    policy = made(ports[kind], kind)
    # The names are those of openpi's trainer.
    assert policy.parameters().keys() == policy.model.model.trained.state_dict().keys()
    check_pushed_weights(policy, lambda: begun(policy, kind, 0).act(seen(kind, 0)).action, part)


@patched
def test_chunks_follow_the_plan(port: Path) -> None:
    policy = made(port)
    plan = begun(policy, "pi0", 1).act(seen("pi0", 1)).action[1:]
    guided = begun(policy, "pi0", 0).act(seen("pi0", 0, **{LEFTOVER: plan, DELAY: 2})).action

    # The next call is not guided.
    session = copy.copy(policy)
    session.reset(seen("pi0", 0), WORDS[0], seed=0)
    free = session.act(seen("pi0", 0)).action
    assert np.abs(guided[:2] - plan[:2]).max() < 0.2 * np.abs(free[:2] - plan[:2]).max()


LEVEL = 0.5
ALL = ["logprob", "entropy", "replay"]


@patched
def test_an_observation_is_on_the_device_before_its_batch_begins(port: Path) -> None:
    policy, view = made(port), seen("pi0", 0)
    session = begun(policy, "pi0", 0)
    view.prepared = frame = session.prepare(view)
    assert frame.inputs.block is not None
    act = session.act(view)
    assert frame.inputs.block is None, "the copy is freed after the batch"
    expected = begun(policy, "pi0", 0).act(seen("pi0", 0))
    np.testing.assert_array_equal(act.action, expected.action)


@patched
def test_the_log_probability_is_that_of_the_network_itself(
    port: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    policy = made(port, noise_level=LEVEL)
    assert policy.contract.behaviour == tuple(ALL)
    act = begun(policy, "pi0", 0).act(seen("pi0", 0, **{WANT: ALL, SAMPLES: 2}))

    network, velocities = policy.model.model.trained, []
    session = begun(policy, "pi0", 0)
    inputs = session.perceive(seen("pi0", 0)).inputs
    observation = _observation(policy.model.model.stack([inputs]))
    preprocess = network._preprocess_observation
    monkeypatch.setattr(
        network, "_preprocess_observation", lambda obs, **_: preprocess(obs, train=False)
    )
    hook = network.action_out_proj.register_forward_hook(
        lambda _module, _inputs, output: velocities.append(output)
    )

    def velocity(noisy: Any, time: float) -> Any:
        """Return the velocity of the network's training pass, whose noisy actions are `noisy` at
        any time, because noise and actions are equal.
        """
        with torch.no_grad():
            network.forward(
                observation, noisy, noise=noisy, time=torch.tensor([time], dtype=torch.float32)
            )
        return velocities[-1]

    behaviour, distribution = act.info[BEHAVIOUR], act.info[DISTRIBUTION]
    chains = [behaviour["replay"]["chain"], *distribution["replay"]["chain"]]
    logprobs = [behaviour["logprob"], *distribution["logprob"]]
    for chain, logprob in zip(chains, logprobs, strict=True):
        expected = logprob_of_steps(velocity, chain, LEVEL)[:, :7]
        np.testing.assert_allclose(logprob, expected, atol=5e-3)
    hook.remove()


@patched
def test_the_samples_of_an_observation_are_of_one_reading_of_it(
    port: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, encoded_rows = made(port, noise_level=LEVEL), []
    network = policy.model.model.trained
    embed = network.embed_prefix

    def counted(images: Any, *args: Any) -> Any:
        encoded_rows.append(len(images[0]))
        return embed(images, *args)

    monkeypatch.setattr(network, "embed_prefix", counted)
    views = [seen("pi0", 0), seen("pi0", 1, **{SAMPLES: 8, WANT: ALL}), seen("pi0", 2)]

    def act() -> list[Any]:
        sessions = [begun(policy, "pi0", i) for i in range(3)]
        # The first instruction is too long, so this row is not computed.
        sessions[0].reset(views[0], "pick up the cube " * 50)
        return policy.act_batch(views, sessions)

    shared = act()
    monkeypatch.setattr(base_policy, "shared_frames", lambda rows: (list(range(len(rows))),) * 2)
    separate = act()
    assert encoded_rows == [2, 10]
    assert isinstance(shared[0], InvalidObservation)

    alone = begun(policy, "pi0", 1).act(views[1]).info[BEHAVIOUR]["replay"]["chain"]
    chain = shared[1].info[BEHAVIOUR]["replay"]["chain"]
    np.testing.assert_allclose(chain, alone, atol=10 * BATCHED)
    for result, expected in zip(shared[1:], separate[1:], strict=True):
        np.testing.assert_allclose(result.action, expected.action, atol=10 * BATCHED)
    samples = [acts[1].info[DISTRIBUTION]["samples"] for acts in (shared, separate)]
    np.testing.assert_allclose(*samples, atol=10 * BATCHED)


@patched
@pytest.mark.verifies("loading")
def test_a_lost_tensor_is_an_error(port: Path, tmp_path: Path, tiny: ModuleType) -> None:
    from safetensors.torch import load_file, save_file

    tensors = load_file(port / "model.safetensors")
    del tensors["action_out_proj.bias"]
    save_file(tensors, tmp_path / "model.safetensors")
    tiny.save_statistics(tmp_path, "pi0")
    with pytest.raises(ConfigError, match=r"action_out_proj\.bias"):
        made(tmp_path)


@pytest.mark.skipif(PATCHED, reason="transformers is patched here")
def test_transformers_as_it_is_is_refused_with_the_cure(tmp_path: Path, tiny: ModuleType) -> None:
    tiny.save_statistics(tmp_path, "pi0")
    (tmp_path / "model.safetensors").touch()
    with pytest.raises(ConfigError, match="transformers_replace"):
        made(tmp_path)
