"""OpenVLA on a tiny random checkpoint made with OpenVLA's own code."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from pushed_weights import check_pushed_weights
from transformers import AutoTokenizer

from plugins.vlagents_ray_models.tests.families.openvla.conftest import (
    LIBRARIES,
    WORDS,
    begun,
    seen,
)
from plugins.vlagents_ray_models.tests.families.openvla.upstream import module
from vlagents_ray.errors import InvalidObservation, MissingCamera
from vlagents_ray.interface import BEHAVIOUR, DISTRIBUTION, SAMPLES, WANT, Act
from vlagents_ray.testing import check_agent
from vlagents_ray_models.openvla.policy import OpenVLA
from vlagents_ray_models.openvla.prismatic import crop_center, resize

pytestmark = [pytest.mark.source("OPENVLA_SRC"), *LIBRARIES]


@pytest.fixture
def policy(loaded: Callable[..., Any]) -> OpenVLA:
    return loaded("openvla")


def upstream(folder: Path, image: np.ndarray, words: str, unnorm_key: str) -> np.ndarray:
    """Return the action (7,) of OpenVLA's own `predict_action`."""
    modeling = module("OPENVLA_SRC", "extern.hf.modeling_prismatic")
    network = modeling.OpenVLAForActionPrediction.from_pretrained(folder).eval()
    network.norm_stats = json.loads((folder / "dataset_statistics.json").read_text())

    processing = module("OPENVLA_SRC", "extern.hf.processing_prismatic")
    processor = processing.PrismaticProcessor(
        processing.PrismaticImageProcessor.from_pretrained(folder),
        AutoTokenizer.from_pretrained(folder),
    )
    inputs = processor(
        f"In: What action should the robot take to {words.lower()}?\nOut:", Image.fromarray(image)
    )
    return network.predict_action(**inputs, unnorm_key=unnorm_key, do_sample=False)


def test_keeps_the_contract(checkpoint: Callable[[str], Path]) -> None:
    agent = OpenVLA.from_config(
        {"checkpoint": str(checkpoint("openvla")), "unnorm_key": "bridge_orig"}
    )
    check_agent(agent, instructions=WORDS, steps=2, atol=0)


@pytest.mark.verifies("parity")
@pytest.mark.parametrize("seed", range(3))
def test_answers_what_upstream_answers(
    policy: OpenVLA, checkpoint: Callable[[str], Path], seed: int
) -> None:
    [row] = begun(policy, seed).act(seen(seed)).action
    want = upstream(checkpoint("openvla"), seen(seed).cameras["front"], WORDS[seed], "bridge_orig")
    assert np.array_equal(row, want.astype(np.float32))


@pytest.mark.verifies("batches")
@pytest.mark.parametrize("size", [2, 3, 8])
def test_a_session_gets_the_same_in_any_company(policy: OpenVLA, size: int) -> None:
    alone = [begun(policy, seed).act(seen(seed)).action for seed in range(size)]
    together = policy.act_batch(
        [seen(seed) for seed in range(size)], [begun(policy, seed) for seed in range(size)]
    )
    for action, act in zip(alone, together, strict=True):
        assert isinstance(act, Act)
        assert np.array_equal(action, act.action)
    # Their observations and instructions differ, and so do their actions.
    assert len({action.tobytes() for action in alone}) == size


def test_a_session_may_have_another_datasets_units(
    policy: OpenVLA, checkpoint: Callable[[str], Path]
) -> None:
    sessions = [
        begun(policy, 0),
        begun(policy, 0, unnorm_key="libero_spatial"),
        begun(policy, 0),
    ]
    views = [seen(0), seen(0), seen(0, unnorm_key="libero_spatial_no_noops")]
    plain, reset, observed = policy.act_batch(views, sessions)
    want = upstream(
        checkpoint("openvla"), seen(0).cameras["front"], WORDS[0], "libero_spatial_no_noops"
    )
    assert np.array_equal(reset.action[0], want.astype(np.float32))
    assert np.array_equal(observed.action, reset.action)
    assert not np.array_equal(plain.action, reset.action)


@pytest.mark.verifies("isolation")
@pytest.mark.parametrize(
    ("change", "error"),
    [
        (lambda obs: obs.info.update(unnorm_key="bridge"), InvalidObservation),
        (lambda obs: obs.info.update(unnorm_key=3), InvalidObservation),
        (lambda obs: obs.cameras.pop("front"), MissingCamera),
    ],
)
def test_a_bad_request_fails_alone(
    policy: OpenVLA, change: Callable[[Any], Any], error: type[Exception]
) -> None:
    obs = seen(0)
    change(obs)
    bad, good = policy.act_batch([obs, seen(1)], [begun(policy, 0), begun(policy, 1)])
    assert isinstance(bad, error)
    assert np.array_equal(good.action, begun(policy, 1).act(seen(1)).action)


def test_an_instruction_longer_than_the_model_was_trained_for_is_refused(policy: OpenVLA) -> None:
    session = begun(policy, 0)
    session.reset(seen(0), "go " * 2048)
    with pytest.raises(InvalidObservation, match="expected at most 2048 tokens with the prompt"):
        session.act(seen(0))


def test_an_unknown_dataset_is_refused_when_an_episode_begins(policy: OpenVLA) -> None:
    with pytest.raises(
        InvalidObservation,
        match=r"expected one of .*bridge_orig.*libero_spatial_no_noops.*got 'aloha'",
    ):
        begun(policy, 0, unnorm_key="aloha")


def test_it_acts_with_pushed_weights(loaded: Callable[..., Any]) -> None:
    policy = loaded("openvla", seed=1)  # nobody else's
    check_pushed_weights(policy, lambda: begun(policy, 0).act(seen(0)).action)


@pytest.mark.library("torchao")
def test_quantized_it_acts_from_weights_of_8_bits(loaded: Callable[..., Any]) -> None:
    quantized = loaded("openvla", quantization="int8")
    assert begun(quantized, 0).act(seen(0)).action.shape == (1, 7)
    assert type(quantized.model.base.network.language_model.lm_head.weight).__name__ == "Int8Tensor"


def test_samples_are_drawn_from_the_distribution_whose_moments_are_stated(policy: OpenVLA) -> None:
    act = begun(policy, 0).act(seen(0, **{SAMPLES: 1000}))
    assert np.array_equal(act.action, begun(policy, 0).act(seen(0)).action)
    distribution = act.info[DISTRIBUTION]
    assert distribution["samples"].shape == (1000, 1, 7)

    # No number precedes the first one, so that its draws have exactly these moments.
    first = distribution["samples"][:, 0, 0]
    mean, std = distribution["mean"][0, 0], distribution["std"][0, 0]
    assert first.mean() == pytest.approx(mean, abs=4 * std / 1000**0.5)
    assert first.std() == pytest.approx(std, rel=0.1)


def test_samples_share_their_sessions_prompt(
    policy: OpenVLA, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = []
    backbone = policy.model.base.network.vision_backbone
    forward = backbone.forward
    monkeypatch.setattr(
        backbone, "forward", lambda pixels: read.append(len(pixels)) or forward(pixels)
    )
    policy.act_batch([seen(0, **{SAMPLES: 5}), seen(1)], [begun(policy, 0), begun(policy, 1)])
    assert read == [2]


ALL = ["logprob", "entropy", "replay"]


def scored(policy: OpenVLA, seed: int, tokens: np.ndarray) -> torch.distributions.Categorical:
    """Return the distribution over bins of each token, given the tokens before it, from one pass
    over the whole sequence.
    """
    model = policy.model.base
    pixels = model.pixels([policy.perceive(seen(seed))])[0]
    [patches] = model.network.projector(model.network.vision_backbone(pixels))
    words = model.embed(torch.tensor(model.tokens(WORDS[seed])))
    sequence = torch.cat([words[:1], patches, words[1:], model.embed(torch.tensor(tokens[:-1]))])
    logits = model.network.language_model(inputs_embeds=sequence[None]).logits[0, -len(tokens) :]
    return torch.distributions.Categorical(logits=logits[:, 32000 - 256 :][:, :256].double())


@pytest.mark.parametrize("seed", range(2))
def test_the_log_probability_is_that_of_the_tokens_in_one_pass_over_them(
    policy: OpenVLA, seed: int
) -> None:
    acts = policy.act_batch(
        [seen(i, **{WANT: ALL}) for i in range(2)], [begun(policy, i) for i in range(2)]
    )
    behaviour = acts[seed].info[BEHAVIOUR]
    [tokens] = behaviour["replay"]["tokens"]
    with torch.no_grad():
        categorical = scored(policy, seed, tokens)
    np.testing.assert_allclose(
        behaviour["logprob"][0], categorical.log_prob(torch.tensor(tokens) - 31744), atol=1e-4
    )
    assert behaviour["entropy"] == pytest.approx(categorical.entropy().sum().item(), abs=1e-4)
    assert np.array_equal(acts[seed].action[0], unit(policy, tokens))


def unit(policy: OpenVLA, tokens: np.ndarray) -> np.ndarray:
    """Return the action of tokens."""
    base = policy.model.base
    bin_logits = torch.zeros(*tokens.shape, 256).double()
    values, *_ = base.bins.describe(torch.tensor(tokens), bin_logits)
    return base.statistics.scale("bridge_orig").restore(values)


def test_an_act_of_which_something_is_wanted_is_drawn_and_others_are_the_likeliest(
    policy: OpenVLA,
) -> None:
    drawn = [begun(policy, 0).act(seen(0, **{WANT: ["logprob"]})) for _ in range(2)]
    assert np.array_equal(drawn[0].action, drawn[1].action)  # it is of the session's own generator
    likeliest = begun(policy, 0).act(seen(0))
    assert not np.array_equal(drawn[0].action, likeliest.action)
    assert BEHAVIOUR not in likeliest.info


def test_each_sample_has_its_log_probability(policy: OpenVLA) -> None:
    act = begun(policy, 0).act(seen(0, **{SAMPLES: 3, WANT: ALL}))
    distribution = act.info[DISTRIBUTION]
    assert distribution["logprob"].shape == distribution["samples"].shape == (3, 1, 7)
    with torch.no_grad():
        for (tokens,), (logprob,) in zip(
            distribution["replay"]["tokens"], distribution["logprob"], strict=True
        ):
            expected = scored(policy, 0, tokens).log_prob(torch.tensor(tokens) - 31744)
            np.testing.assert_allclose(logprob, expected, atol=1e-4)


def test_pictures_may_be_those_of_libero(loaded: Callable[..., Any]) -> None:
    cropping = loaded("openvla", center_crop=True)
    obs = seen(0)
    [cropped] = cropping.perceive(obs).values()
    [plain] = loaded("openvla").perceive(obs).values()
    [expected] = cropping.model.base.stage([crop_center(resize(obs.cameras["front"]))]).values()
    np.testing.assert_array_equal(cropped, expected)
    assert not np.array_equal(cropped, plain)


# Transformers 4.40 imports such code with it.
@pytest.mark.filterwarnings("ignore:the load_module:DeprecationWarning")
def test_a_checkpoints_own_code_runs_where_that_is_allowed(
    loaded: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("transformers.dynamic_module_utils.HF_MODULES_CACHE", str(tmp_path))
    monkeypatch.syspath_prepend(tmp_path)
    policy = loaded("remote", trust_remote_code=True)
    assert type(policy.model.base.network).__module__.startswith("transformers_modules.")
    same = loaded("remote")
    assert np.array_equal(begun(policy, 0).act(seen(0)).action, begun(same, 0).act(seen(0)).action)


def test_the_first_version_has_its_own_prompt(
    checkpoint: Callable[[str], Path], tmp_path: Path
) -> None:
    (tmp_path / "openvla-v01-7b").symlink_to(checkpoint("openvla"))
    policy = OpenVLA.from_config(
        {"checkpoint": str(tmp_path / "openvla-v01-7b"), "unnorm_key": "bridge_orig"}
    )
    policy.initialize()
    prompt = policy.model.base.tokenizer.decode(policy.model.base.tokens("Push")[1:-1])
    assert prompt.startswith("A chat between a curious user")
    assert prompt.endswith("USER: What action should the robot take to push? ASSISTANT:")
