"""A LoRA adapter in the settings of a policy: the loaded policy acts as its base with merged
weights.
"""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adapted_network import DIM, LAYERS, Small, base, merge, pairs, save
from in_flight import answered
from pushed_weights import check_pushed_weights

from vlagents_ray import Obs
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import DISTRIBUTION, POLICY, SAMPLES, Act
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.policies.base import ModelConfig
from vlagents_ray.policies.base import policy as base_policy
from vlagents_ray.policies.base.adapter import LoraAdapter
from vlagents_ray.policies.base.checkpoint import used_checkpoints
from vlagents_ray.policies.base.checkpoint_files import digest
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.weights import ModelWeights, PushOptions
from vlagents_ray.weights.trainable import portable

pytestmark = pytest.mark.torch

RTOL = 1e-5


class WithoutAdapters(Small):
    Config = ModelConfig
    network = None


class WithoutNetwork(Small):
    network = None


def loaded(tmp_path: Path, **config: Any) -> Small:
    policy = Small.from_config({"checkpoint": str(base(tmp_path)), **config})
    policy.initialize()
    return policy


def network(tmp_path: Path) -> Any:
    return loaded(tmp_path).model


def at(seed: int, **info: Any) -> Obs:
    return Obs(
        state={"joints": np.random.default_rng(seed).normal(size=DIM).astype(np.float32)}, info=info
    )


def begun(policy: Small, seed: int) -> Any:
    session = AgentCopies(policy).make()
    session.reset(at(seed), None, seed=seed)
    return session


def with_merged(tmp_path: Path, values: dict[str, np.ndarray], **options: float) -> Small:
    """Return the base policy, whose weights are changed after it is loaded."""
    policy = loaded(tmp_path)
    merge(policy.model, values, **options)
    return policy


def test_a_policy_with_an_adapter_acts_as_its_base_with_merged_weights(tmp_path: Path) -> None:
    values = pairs(network(tmp_path), LAYERS, 4)
    adapted = loaded(tmp_path, adapter=str(save(tmp_path / "stack", values)))
    merged, unchanged = with_merged(tmp_path, values), loaded(tmp_path)
    for name, weight in merged.model.state_dict().items():
        np.testing.assert_allclose(adapted.model.state_dict()[name], weight, rtol=RTOL, atol=RTOL)

    seeds = range(3)
    views = [at(seed, **{SAMPLES: seed}) for seed in seeds]
    acts = adapted.act_batch(views, [begun(adapted, seed) for seed in seeds])
    for seed, act in enumerate(acts):
        expected = begun(merged, seed).act(views[seed])
        assert isinstance(act, Act)
        np.testing.assert_allclose(act.action, expected.action, rtol=RTOL, atol=RTOL)
        assert np.abs(act.action - begun(unchanged, seed).act(views[seed]).action).max() > 0.1
        if seed:
            np.testing.assert_allclose(
                act.info[DISTRIBUTION]["samples"],
                expected.info[DISTRIBUTION]["samples"],
                rtol=RTOL,
                atol=RTOL,
            )


def test_the_identity_of_the_weights_covers_the_base_and_the_adapter(tmp_path: Path) -> None:
    values = pairs(network(tmp_path), LAYERS, 2)
    stack, pour = save(tmp_path / "stack", values), save(tmp_path / "pour", values, lora_alpha=1)

    def identity(adapter: Path | None) -> tuple[str, str]:
        """Return the digest of the files, and the fingerprint of the values in memory."""
        config = {} if adapter is None else {"adapter": str(adapter)}
        engine = Engine(Small.from_config({"checkpoint": str(base(tmp_path)), **config}))
        engine.start()
        try:
            info = answered(engine, "s", Request("reset", at(0))).info
            act = answered(engine, "s", Request("act", at(1))).act
        finally:
            engine.close()
        assert info is not None
        assert act is not None
        return info["weights"], act.info[POLICY]["fingerprint"]

    found = [identity(adapter) for adapter in (None, stack, pour)]
    for identities in zip(*found, strict=True):
        assert len(set(identities)) == len(found)
    assert identity(stack) == found[1]
    (tmp_path / "base" / "other.bin").write_bytes(b"other")
    assert identity(stack)[0] != found[1][0]


def test_an_adapter_within_its_base_does_not_replace_it(tmp_path: Path) -> None:
    folder = save(base(tmp_path) / "adapter", pairs(network(tmp_path), LAYERS, 2))
    found = loaded(tmp_path, adapter=str(folder)).weights_id
    assert found == {"digest": digest([tmp_path / "base", folder]), "revision": None}


@pytest.mark.filterwarnings("ignore:quantization")
def test_an_adapter_is_merged_before_the_weights_are_quantized(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = pairs(network(tmp_path), LAYERS, 2)
    folder, merged = save(tmp_path / "stack", values), with_merged(tmp_path, values).model
    quantized = []

    def note(policy: Small, kind: str) -> None:
        quantized.append((kind, policy.model["see"].weight.detach().clone()))

    monkeypatch.setattr(base_policy, "quantize", note)
    loaded(tmp_path, adapter=str(folder), quantization="int8")
    [(kind, weight)] = quantized
    assert kind == "int8"
    np.testing.assert_allclose(weight, merged["see"].weight.detach(), rtol=RTOL, atol=RTOL)


def test_a_layer_with_an_adapter_no_longer_shares_its_weights(tmp_path: Path) -> None:
    import torch

    tied = torch.nn.ModuleDict({"embed": torch.nn.Embedding(5, 3), "see": torch.nn.Linear(3, 5)})
    tied["see"].weight = tied["embed"].weight
    before = tied["embed"].weight.detach().clone()
    values = pairs(tied, ["see"], 2)
    LoraAdapter.find(str(save(tmp_path / "stack", values))).merge_into(tied)
    assert torch.equal(tied["embed"].weight, before)
    down, up = (values[f"base_model.model.see.lora_{part}.weight"] for part in "AB")
    expected = before.numpy() + 2 * up @ down
    np.testing.assert_allclose(tied["see"].weight.detach(), expected, rtol=RTOL, atol=RTOL)


def test_a_learner_pushes_all_weights_or_the_layers_that_its_adapter_changes(
    tmp_path: Path,
) -> None:
    values = pairs(network(tmp_path), LAYERS, 2)
    policy = loaded(tmp_path, adapter=str(save(tmp_path / "stack", values)))
    check_pushed_weights(policy, lambda: begun(policy, 0).act(at(0)).action)

    policy = loaded(tmp_path, adapter=str(tmp_path / "stack"))
    trained = pairs(policy.model, LAYERS[2:], 2, seed=9)
    learner = with_merged(tmp_path, values | trained)
    names = [f"{layer}.weight" for layer in LAYERS[2:]]
    pushed = {name: value for name, value in learner.model.state_dict().items() if name in names}
    weights, options = ModelWeights(policy, threading.Lock()), PushOptions(partial=True)
    weights.stage(1, pushed, options)
    weights.commit(1, options, list)
    weights.use(weights.newest)
    np.testing.assert_allclose(
        begun(policy, 1).act(at(1)).action,
        begun(learner, 1).act(at(1)).action,
        rtol=RTOL,
        atol=RTOL,
    )


def test_an_adapter_is_an_unknown_key_in_the_settings_of_other_families() -> None:
    with pytest.raises(ConfigError, match="adapter: there is no such setting"):
        WithoutAdapters.from_config({"checkpoint": "any", "adapter": "any"})


def test_a_policy_that_accepts_adapters_must_name_its_network() -> None:
    policy = WithoutNetwork.from_config({"checkpoint": "any", "adapter": "any"})
    with pytest.raises(ConfigError, match=r"WithoutNetwork.network: expected the name"):
        policy.initialize()


@pytest.mark.parametrize(
    ("config", "says"),
    [
        ({"peft_type": "LOHA"}, "peft_type: expected 'LORA', got 'LOHA'"),
        ({"use_dora": True}, "expected a plain LoRA of linear layers, got {'use_dora': True}"),
        ({"modules_to_save": ["head"]}, "got {'modules_to_save'"),
        ({"bias": "all"}, "got {'bias': 'all'}"),
        ({"alpha_pattern": {"see": 3}}, "alpha_pattern"),
        ({"a_setting_of_later_versions": 1}, "a_setting_of_later_versions"),
        ({"init_lora_weights": "pissa_niter_4"}, "init_lora_weights"),
        ({"lora_alpha": None}, "lora_alpha: expected a number, got None"),
        ({"lora_alpha": True}, "lora_alpha: expected a number, got True"),
        ({"lora_alpha": np.inf}, "lora_alpha: expected a number, got inf"),
        ({"base_model_name_or_path": "other/base"}, None),
    ],
)
def test_another_kind_of_adapter_is_refused(
    tmp_path: Path, config: dict[str, Any], says: str | None
) -> None:
    save(tmp_path / "stack", pairs(network(tmp_path), LAYERS, 2), **config)
    if says is None:  # a local folder may be a copy of a repository on the hub
        loaded(tmp_path, adapter=str(tmp_path / "stack"))
        return
    with pytest.raises(ConfigError, match=f"{says}"):
        loaded(tmp_path, adapter=str(tmp_path / "stack"))


def test_rank_stabilised_adapters_have_their_own_scale(tmp_path: Path) -> None:
    values = pairs(network(tmp_path), LAYERS, 4)
    save(tmp_path / "stack", values, use_rslora=True, lora_alpha=3)
    policy = loaded(tmp_path, adapter=str(tmp_path / "stack"))
    merged = with_merged(tmp_path, values, scale=3 / 2)
    got, expected = (begun(agent, 0).act(at(0)).action for agent in (policy, merged))
    np.testing.assert_allclose(got, expected, rtol=RTOL, atol=RTOL)


def broken(values: dict[str, np.ndarray], what: str) -> dict[str, np.ndarray]:
    first = "base_model.model.see.lora_A.weight"
    changes: dict[str, dict[str, Any]] = {
        "unknown": {"base_model.model.eye.lora_A.weight": np.ones((2, 4), np.float32)}
        | {"base_model.model.eye.lora_B.weight": np.ones((8, 2), np.float32)},
        "half": {"base_model.model.head.1.lora_A.weight": np.ones((2, 4), np.float32)},
        "shape": {first: np.ones((2, 5), np.float32)},
        "empty": {first: np.ones((0, 4), np.float32)}
        | {"base_model.model.see.lora_B.weight": np.ones((8, 0), np.float32)},
        "prefix": {"see.lora_A.weight": np.ones((2, 4), np.float32)}
        | {"see.lora_B.weight": np.ones((8, 2), np.float32)},
        "nan": {first: np.full((2, 4), np.nan, np.float32)},
        "whole numbers": {first: np.ones((2, 4), np.int8)},
        "no linear": {"base_model.model.head.1.lora_A.weight": np.ones((2, 4), np.float32)}
        | {"base_model.model.head.1.lora_B.weight": np.ones((8, 2), np.float32)},
        "attention": {
            "base_model.model.attention.out_proj.lora_A.weight": np.ones((2, 8), np.float32)
        }
        | {"base_model.model.attention.out_proj.lora_B.weight": np.ones((8, 2), np.float32)},
        "changed": {"base_model.model.see.base_layer.weight": np.ones((8, 4), np.float32)},
        "whole": {"base_model.model.see.weight": np.ones((8, 4), np.float32)},
    }
    return {**values, **changes[what]}


@pytest.mark.parametrize(
    ("what", "says"),
    [
        (
            "unknown",
            (r"got 1 of 5 that it does not have: \['eye'\]; use an adapter that was trained on"),
        ),
        ("half", r"expected pairs .*, got \['base_model.model.head.1.lora_B.weight'\]"),
        (
            "shape",
            r"see: expected A and B for weights of shape \(8, 4\), got A \(2, 5\) and B \(8, 2\)",
        ),
        ("empty", r"see: expected A and B for .*, got A \(0, 4\) and B \(8, 0\)"),
        ("prefix", r"expected pairs .*, got \['see.lora_A.weight', 'see.lora_B.weight'\]"),
        ("nan", "see: expected values that are finite as .*, got NaN or infinity"),
        ("whole numbers", "see: expected real numbers, got A int8 and B float32"),
        (
            "no linear",
            "expected adapters of linear layers and plain convolutions, got {'head.1': 'Tanh'}",
        ),
        ("attention", "got {'attention.out_proj': 'NonDynamicallyQuantizableLinear'}"),
        (
            "changed",
            (
                r"expected pairs .* and no changes of the base, got "
                r"\['base_model.model.see.base_layer.weight'\]"
            ),
        ),
        ("whole", r"expected pairs .*, got \['base_model.model.see.weight'\]"),
    ],
)
def test_an_adapter_that_does_not_fit_is_refused(tmp_path: Path, what: str, says: str) -> None:
    save(tmp_path / "stack", broken(pairs(network(tmp_path), LAYERS, 2), what))
    with pytest.raises(ConfigError, match=f"{says}"):
        loaded(tmp_path, adapter=str(tmp_path / "stack"))


def test_values_of_the_base_beside_an_adapter_may_only_be_the_same(tmp_path: Path) -> None:
    made = network(tmp_path)
    values = pairs(made, LAYERS, 2)
    same = {"base_model.model.see.base_layer.weight": made["see"].weight.detach().numpy().copy()}
    save(tmp_path / "stack", values | same)
    save(tmp_path / "plain", values)
    got, expected = (
        begun(loaded(tmp_path, adapter=str(tmp_path / name)), 0).act(at(0)).action
        for name in ("stack", "plain")
    )
    assert np.array_equal(got, expected)


def test_a_truncated_or_absent_file_is_refused(tmp_path: Path) -> None:
    folder = save(tmp_path / "stack", pairs(network(tmp_path), LAYERS, 2))
    file = folder / "adapter_model.safetensors"
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(ConfigError, match=r"is damaged, or has a different format"):
        loaded(tmp_path, adapter=str(tmp_path / "stack"))
    file.rename(folder / "adapter_model.bin")  # a pickle, according to its name
    with pytest.raises(ConfigError, match=r"expected \['adapter_model.safetensors'\] in it"):
        loaded(tmp_path, adapter=str(tmp_path / "stack"))


def test_an_adapter_of_another_base_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "weights.bin").write_bytes(b"other")
    folder = save(
        tmp_path / "stack", pairs(network(tmp_path), LAYERS, 2), base_model_name_or_path=str(other)
    )
    with pytest.raises(
        ConfigError,
        match=(
            r"expected an adapter of '.*base', the policy's checkpoint, got "
            r"one trained on '.*other'"
        ),
    ):
        loaded(tmp_path, adapter=str(tmp_path / "stack"))
    (other / "weights.bin").write_bytes(b"base")  # a copy of the base
    loaded(tmp_path, adapter=str(tmp_path / "stack"))
    config = json.loads((folder / "adapter_config.json").read_text())
    (folder / "adapter_config.json").write_text(
        json.dumps(config | {"base_model_name_or_path": str(tmp_path / "base")})
    )
    loaded(tmp_path, adapter=str(tmp_path / "stack"))


def test_a_file_of_the_folder_is_not_the_adapter(tmp_path: Path) -> None:
    folder = save(tmp_path / "stack", pairs(network(tmp_path), LAYERS, 2))
    with pytest.raises(
        ConfigError,
        match=r"expected the folder with adapter_config.json.*, got a file",
    ):
        loaded(tmp_path, adapter=str(folder / "adapter_model.safetensors"))


@pytest.mark.parametrize("named", ["/" + 300 * "a", "~nobody_here/base", "\0"])
def test_a_base_that_cannot_be_looked_up_is_unknown(tmp_path: Path, named: str) -> None:
    save(tmp_path / "stack", pairs(network(tmp_path), LAYERS, 2), base_model_name_or_path=named)
    loaded(tmp_path, adapter=str(tmp_path / "stack"))


@pytest.mark.parametrize(
    "content", ["[" * 100_000, '{"peft_type": "LORA", "base_model_name_or_path": 3}', "\0"]
)
def test_a_damaged_config_is_refused(tmp_path: Path, content: str) -> None:
    folder = save(tmp_path / "stack", pairs(network(tmp_path), LAYERS, 2))
    (folder / "adapter_config.json").write_text(content)
    with pytest.raises(ConfigError, match=r"adapter_config\.json: .*expected|cannot be read"):
        loaded(tmp_path, adapter=str(tmp_path / "stack"))


def test_the_change_is_scaled_and_added_before_it_is_rounded(tmp_path: Path) -> None:
    small = network(tmp_path).half()
    values = pairs(small, LAYERS, 2)
    tiny = {
        name: value * np.float32(1e-9) if ".lora_B." in name else value
        for name, value in values.items()
    }
    before = small["see"].weight.detach().double().numpy()
    LoraAdapter.find(str(save(tmp_path / "tiny", tiny, lora_alpha=2e9))).merge_into(small)
    down, up = (values[f"base_model.model.see.lora_{part}.weight"] for part in "AB")
    expected = (before + up.astype(np.float64) @ down).astype(np.float16)
    assert np.array_equal(small["see"].weight.detach().numpy(), expected)

    huge = LoraAdapter.find(str(save(tmp_path / "huge", values, lora_alpha=2e6)))
    with pytest.raises(
        ConfigError, match=r"expected values that are finite as torch\.float16, got NaN or infinity"
    ):
        huge.merge_into(small)


def test_an_adapter_may_be_saved_in_bfloat16(tmp_path: Path) -> None:
    import torch

    values = pairs(network(tmp_path), LAYERS, 2)
    rounded = {name: torch.from_numpy(value).bfloat16() for name, value in values.items()}
    saved = {name: portable(value) for name, value in rounded.items()}
    policy = loaded(tmp_path, adapter=str(save(tmp_path / "stack", saved)))
    merged = with_merged(tmp_path, {name: value.float().numpy() for name, value in rounded.items()})
    got, expected = (begun(agent, 0).act(at(0)).action for agent in (policy, merged))
    np.testing.assert_allclose(got, expected, rtol=RTOL, atol=RTOL)


@pytest.mark.parametrize("settings", [{"groups": 2}, {"padding": 1, "padding_mode": "reflect"}])
def test_other_convolutions_are_rejected(tmp_path: Path, settings: dict[str, Any]) -> None:
    import torch

    module = torch.nn.ModuleDict({"look": torch.nn.Conv2d(4, 8, 2, **settings)})
    adapter = LoraAdapter.find(str(save(tmp_path / "stack", pairs(module, ["look"], 2))))
    with pytest.raises(ConfigError, match=r"got {'look': 'Conv2d'}; merge the fine-tune into"):
        adapter.merge_into(module)


def test_the_base_of_an_adapter_may_be_named_by_its_hub_id_or_an_outer_folder(
    tmp_path: Path,
) -> None:
    LoraAdapter(tmp_path, {"base_model_name_or_path": "org/base@main"}).require_base("org/base", [])
    with pytest.raises(ConfigError, match="got one trained on 'org/other'"):
        LoraAdapter(tmp_path, {"base_model_name_or_path": "org/other"}).require_base("org/base", [])

    (tmp_path / "log.bin").write_bytes(b"log")
    folder = base(tmp_path)
    outer = LoraAdapter(tmp_path, {"base_model_name_or_path": str(tmp_path)})
    outer.require_base(str(folder), [folder])


def test_a_policy_without_files_of_its_own_has_no_identity(tmp_path: Path) -> None:
    class WithoutFiles(Small):
        def load(self) -> Any:
            with used_checkpoints():  # the files of the base are not known
                return super().load()

    folder = save(tmp_path / "stack", pairs(network(tmp_path), LAYERS, 2))
    policy = WithoutFiles.from_config({"checkpoint": str(base(tmp_path)), "adapter": str(folder)})
    with used_checkpoints() as found:
        policy.initialize()
    assert (found, policy.weights_id) == ([], None)
