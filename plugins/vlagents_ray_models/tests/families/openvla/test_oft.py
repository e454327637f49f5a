"""OpenVLA-OFT on tiny random checkpoints made with OFT's own code, as it trains them for LIBERO."""

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

from plugins.vlagents_ray_models.tests.families.openvla import tiny
from plugins.vlagents_ray_models.tests.families.openvla.conftest import (
    LIBRARIES,
    WORDS,
    begun,
    seen,
)
from plugins.vlagents_ray_models.tests.families.openvla.upstream import module
from vlagents_ray import Obs
from vlagents_ray.errors import InvalidObservation, MissingCamera, MissingState
from vlagents_ray.interface import BEHAVIOUR, DISTRIBUTION, SAMPLES, WANT, Act
from vlagents_ray.policies.base import Row
from vlagents_ray.policies.base import policy as base_policy
from vlagents_ray.testing import check_agent
from vlagents_ray_models.openvla.oft import OpenVLAOFT
from vlagents_ray_models.openvla.prismatic import crop_center, resize

pytestmark = [pytest.mark.source("OPENVLA_OFT_SRC"), *LIBRARIES]

DIFFUSION = {
    "head": "diffusion",
    "diffusion_steps": tiny.DIFFUSION_STEPS,
    "inference_steps": tiny.DIFFUSION_STEPS,
}
SETTINGS: dict[str, dict[str, Any]] = {
    "oft": {},
    "oft-film": {"film": True},
    "oft-diffusion": DIFFUSION,
    "oft-tokens": {"head": "tokens"},
}
# How far actions may be off those of a lone row, or upstream's, in float32 on a CPU, where they
# reach to about 3. The first step of diffusion divides by what is left of the signal in almost pure
# noise.
SAME = {"oft": 5e-5, "oft-film": 5e-5, "oft-tokens": 1e-6, "oft-diffusion": 1e-3}


@pytest.fixture(params=list(SETTINGS))
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def policy(loaded: Callable[..., Any], kind: str) -> OpenVLAOFT:
    return loaded(kind, **SETTINGS[kind])


@pytest.fixture
def fork(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use attention as in OFT's fork of transformers: each token attends to all tokens that the
    last one attends to.
    """
    attend = torch.nn.functional.scaled_dot_product_attention

    def attend_both_ways(
        *args: Any, attn_mask: Any = None, is_causal: bool = False, **kwargs: Any
    ) -> Any:
        mask = None if attn_mask is None else attn_mask[:, :, -1:]
        return attend(*args, attn_mask=mask, **kwargs)

    monkeypatch.setattr(torch.nn.functional, "scaled_dot_product_attention", attend_both_ways)


class Upstream:
    """A checkpoint that OFT's own code loads and runs (experiments/robot/openvla_utils.py)."""

    def __init__(
        self, folder: Path, kind: str, inference_steps: int = tiny.DIFFUSION_STEPS
    ) -> None:
        self.kind = kind
        self.folder = folder
        modeling = self._module("extern.hf.modeling_prismatic")
        network = modeling.OpenVLAForActionPrediction.from_pretrained(folder)
        if kind == "oft-film":
            backbone = tiny.filmed(network, trained=False)
            network.vision_backbone = self._filled("vision_backbone", backbone)
        network.vision_backbone.set_num_images_in_input(2)
        network.norm_stats = json.loads((folder / "dataset_statistics.json").read_text())
        self.network = network.eval()

        processing = self._module("extern.hf.processing_prismatic")
        self.processor = processing.PrismaticProcessor(
            processing.PrismaticImageProcessor.from_pretrained(folder),
            AutoTokenizer.from_pretrained(folder),
        )

        heads, projectors = self._module("models.action_heads"), self._module("models.projectors")
        sizes = tiny.LLM_DIM, tiny.LLM_DIM, tiny.ACTION_DIM
        components = {
            "proprio_projector": projectors.ProprioProjector(tiny.LLM_DIM, tiny.PROPRIO_DIM)
        }
        if kind == "oft-diffusion":
            head = heads.DiffusionActionHead(*sizes, tiny.DIFFUSION_STEPS)
            head.noise_scheduler.set_timesteps(inference_steps)
            components["noisy_action_projector"] = projectors.NoisyActionProjector(tiny.LLM_DIM)
            components["action_head"] = head
        elif kind != "oft-tokens":
            components["action_head"] = heads.L1RegressionActionHead(*sizes)
        self.components = {
            name: self._filled(name, component) for name, component in components.items()
        }

    def _filled(self, name: str, component: torch.nn.Module) -> torch.nn.Module:
        """Return a component with its saved weights."""
        saved = torch.load(self.folder / f"{name}--100_checkpoint.pt", weights_only=True)
        component.load_state_dict(
            {key.removeprefix("module."): tensor for key, tensor in saved.items()}
        )
        return component.eval()

    @staticmethod
    def _module(name: str) -> Any:
        return module("OPENVLA_OFT_SRC", name)

    def act(self, obs: Obs, words: str, key: str = "bridge_orig") -> np.ndarray:
        """Return the actions (8, 7) of upstream's code."""
        prompt = f"In: What action should the robot take to {words.lower()}?\nOut:"
        front, wrist = (
            self.processor(prompt, Image.fromarray(crop_center(resize(obs.cameras[name]))))
            for name in ("front", "wrist")
        )
        pixels = torch.cat([front["pixel_values"], wrist["pixel_values"]], 1)

        ranges = self.network.norm_stats[key]["proprio"]
        low, high = np.array(ranges["q01"]), np.array(ranges["q99"])
        state = np.concatenate([obs.state["xyz_axis_angle"], obs.state["gripper_qpos"]])
        with torch.inference_mode():
            actions, _ = self.network.predict_action(
                **{**front, "pixel_values": pixels},
                unnorm_key=key,
                proprio=np.clip(2 * (state - low) / (high - low + 1e-8) - 1, -1, 1),
                use_film=self.kind == "oft-film",
                **self.components,
            )
        return actions


@pytest.mark.parametrize("kind", ["oft", "oft-diffusion"], indirect=True)
def test_keeps_the_contract(checkpoint: Callable[[str], Path], kind: str) -> None:
    config = {"checkpoint": str(checkpoint(kind)), "unnorm_key": "bridge_orig", **SETTINGS[kind]}
    views = [seen(seed) for seed in range(3)]
    check_agent(
        OpenVLAOFT.from_config(config), obs=views, instructions=WORDS, steps=2, atol=SAME[kind]
    )


@pytest.mark.verifies("parity")
@pytest.mark.usefixtures("fork")
@pytest.mark.parametrize("seed", [0, 2])
def test_answers_what_upstream_answers(
    policy: OpenVLAOFT,
    checkpoint: Callable[[str], Path],
    kind: str,
    seed: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = begun(policy, seed)
    noise = np.random.default_rng([0, seed]).standard_normal(
        (tiny.CHUNK, tiny.ACTION_DIM), dtype=np.float32
    )
    theirs = Upstream(checkpoint(kind), kind)
    monkeypatch.setattr(torch, "randn", lambda size, **_: torch.from_numpy(noise).reshape(size))
    assert (
        np.abs(session.act(seen(seed)).action - theirs.act(seen(seed), WORDS[seed])).max()
        <= SAME[kind]
    )


@pytest.mark.verifies("parity")
@pytest.mark.usefixtures("fork")
def test_fewer_steps_of_diffusion_are_upstreams(
    checkpoint: Callable[[str], Path], loaded: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = loaded("oft-diffusion", **DIFFUSION | {"inference_steps": 2})
    noise = np.random.default_rng([0, 0]).standard_normal(
        (tiny.CHUNK, tiny.ACTION_DIM), dtype=np.float32
    )
    theirs = Upstream(checkpoint("oft-diffusion"), "oft-diffusion", 2)
    monkeypatch.setattr(torch, "randn", lambda size, **_: torch.from_numpy(noise).reshape(size))
    assert (
        np.abs(begun(policy, 0).act(seen(0)).action - theirs.act(seen(0), WORDS[0])).max()
        <= SAME["oft-diffusion"]
    )


@pytest.mark.verifies("batches")
def test_a_session_gets_the_same_in_any_company(policy: OpenVLAOFT, kind: str) -> None:
    alone = [begun(policy, seed).act(seen(seed)).action for seed in range(8)]
    for size in (2, 3, 8):
        acts = policy.act_batch(
            [seen(seed) for seed in range(size)], [begun(policy, seed) for seed in range(size)]
        )
        for action, act in zip(alone, acts, strict=False):
            assert isinstance(act, Act)
            assert np.abs(action - act.action).max() <= SAME[kind]
    # Their observations and instructions differ, and so do their actions.
    assert len({action.round(3).tobytes() for action in alone}) == 8


@pytest.mark.parametrize(
    ("changed", "kind"),
    [("front", "oft"), ("wrist", "oft"), ("state", "oft"), ("words", "oft-film")],
)
def test_actions_depend_on_each_input(loaded: Callable[..., Any], changed: str, kind: str) -> None:
    policy = loaded(kind, **SETTINGS[kind])
    session, obs = begun(policy, 0), seen(0)
    if changed == "words":
        session.reset(obs, "something else", seed=0)
    elif changed == "state":
        obs.state["gripper_qpos"] = obs.state["gripper_qpos"] + 1
    else:
        obs.cameras[changed] = 255 - obs.cameras[changed]
    assert np.abs(session.act(obs).action - begun(policy, 0).act(seen(0)).action).max() > 0.01


@pytest.mark.parametrize(
    ("kind", "components"),
    [
        ("oft", {"action_head", "proprio_projector"}),
        ("oft-diffusion", {"action_head", "proprio_projector", "noisy_action_projector"}),
        ("oft-film", {"action_head", "proprio_projector", "film"}),
        ("oft-tokens", {"proprio_projector"}),
    ],
)
def test_it_acts_with_pushed_weights(
    loaded: Callable[..., Any], kind: str, components: set[str]
) -> None:
    policy = loaded(kind, seed=1, **SETTINGS[kind])  # policy of this test alone
    assert {name.partition("/")[0] for name in policy.parameters()} == {"vla", *components}
    check_pushed_weights(policy, lambda: begun(policy, 0).act(seen(0)).action)


@pytest.mark.parametrize("kind", ["oft-tokens", "oft-diffusion"], indirect=True)
def test_samples_differ_where_the_model_has_a_distribution(policy: OpenVLAOFT, kind: str) -> None:
    act = begun(policy, 0).act(seen(0, **{SAMPLES: 3}))
    assert np.abs(act.action - begun(policy, 0).act(seen(0)).action).max() <= SAME[kind]
    samples = act.info[DISTRIBUTION]["samples"]
    assert samples.shape == (3, tiny.CHUNK, tiny.ACTION_DIM)
    assert len({sample.round(3).tobytes() for sample in samples}) == 3


@pytest.mark.parametrize("kind", ["oft", "oft-tokens", "oft-diffusion"], indirect=True)
def test_samples_share_the_images_of_their_session(
    policy: OpenVLAOFT, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[int] = []
    backbone = policy.model.base.network.vision_backbone
    forward = backbone.forward
    monkeypatch.setattr(
        backbone, "forward", lambda pixels: read.append(len(pixels)) or forward(pixels)
    )

    views = [seen(0, **{SAMPLES: 3}), seen(1)]
    shared = policy.act_batch(views, [begun(policy, 0), begun(policy, 1)])
    monkeypatch.setattr(
        base_policy, "shared_frames", lambda rows: (list(range(len(rows))), list(range(len(rows))))
    )
    separate = policy.act_batch(views, [begun(policy, 0), begun(policy, 1)])

    assert read == [4, 10]  # images of two cameras
    for shared_act, separate_act in zip(shared, separate, strict=True):
        assert np.abs(shared_act.action - separate_act.action).max() <= SAME[kind]
    samples = [acts[0].info[DISTRIBUTION]["samples"] for acts in (shared, separate)]
    assert np.abs(samples[0] - samples[1]).max() <= SAME[kind]


def test_action_tokens_have_log_probabilities_and_other_heads_have_none(
    loaded: Callable[..., Any],
) -> None:
    assert loaded("oft").contract.behaviour is None
    policy = loaded("oft-tokens", **SETTINGS["oft-tokens"])
    assert policy.contract.behaviour == ("logprob", "entropy", "replay")

    act = begun(policy, 0).act(seen(0, **{SAMPLES: 2, WANT: ["logprob", "entropy", "replay"]}))
    behaviour, distribution = act.info[BEHAVIOUR], act.info[DISTRIBUTION]
    tokens = np.concatenate([behaviour["replay"]["tokens"][None], distribution["replay"]["tokens"]])

    row = Row((begun(policy, 0).perceive(seen(0)),), WORDS[0], None)
    inputs = [policy._model_input(row, "bridge_orig")]
    draws = np.full((1, tiny.CHUNK, tiny.ACTION_DIM), np.nan)
    _, bin_logits = policy.model.choose(inputs, [0], draws)
    *_, logprob, entropy, _ = policy.model.base.bins.describe(
        torch.tensor(tokens), bin_logits.expand(3, -1, -1, -1)
    )
    np.testing.assert_allclose(behaviour["logprob"], logprob[0], atol=1e-4)
    np.testing.assert_allclose(distribution["logprob"], logprob[1:], atol=1e-4)
    assert behaviour["entropy"] == pytest.approx(entropy[0].sum(), rel=1e-4)


def test_regression_is_sure_of_its_only_answer(loaded: Callable[..., Any]) -> None:
    act = begun(loaded("oft"), 0).act(seen(0, **{SAMPLES: 3}))
    assert act.info[DISTRIBUTION]["std"].max() <= SAME["oft"]


@pytest.mark.verifies("isolation")
@pytest.mark.parametrize(
    ("change", "error"),
    [
        (lambda obs: obs.cameras.pop("wrist"), MissingCamera),
        (lambda obs: obs.state.pop("gripper_qpos"), MissingState),
        (lambda obs: obs.state.update(gripper_qpos=np.zeros(3, np.float32)), InvalidObservation),
        (lambda obs: obs.info.update(unnorm_key="aloha"), InvalidObservation),
    ],
)
def test_a_bad_request_fails_alone(
    loaded: Callable[..., Any], change: Callable[[Any], Any], error: type[Exception]
) -> None:
    policy, obs = loaded("oft"), seen(0)
    change(obs)
    bad, good = policy.act_batch([obs, seen(1)], [begun(policy, 0), begun(policy, 1)])
    assert isinstance(bad, error)
    assert isinstance(good, Act)


def test_a_dataset_whose_actions_are_longer_than_the_heads_is_refused_alone(
    loaded: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = loaded("oft")
    longer = {"q01": [0.0] * 14, "q99": [1.0] * 14}
    monkeypatch.setitem(policy.model.base.statistics._datasets, "aloha", {"action": longer})
    bad, good = policy.act_batch(
        [seen(0, unnorm_key="aloha"), seen(1)], [begun(policy, 0), begun(policy, 1)]
    )
    assert isinstance(bad, InvalidObservation)
    assert "expected a dataset of 7 numbers, as the head's, got 'aloha' of 14" in str(bad)
    assert isinstance(good, Act)
