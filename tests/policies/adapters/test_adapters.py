"""LoRA adapters selected per session: one pass for rows with different adapters, each as if its
adapter alone were merged into the base.
"""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adapted_network import DIM, LAYERS, Small, base, merge, pairs, save

from vlagents_ray import Obs
from vlagents_ray.errors import ConfigError, UnknownCheckpoint, UnknownSession
from vlagents_ray.interface import DISTRIBUTION, POLICY, SAMPLES, Act
from vlagents_ray.policies.adapters import LoraAdapter, LoraAdapters, read_adapter
from vlagents_ray.serve.models.agent_copies import AgentCopies

pytestmark = pytest.mark.torch

RTOL = 1e-5


class Plain(Small):
    adaptable = False


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


def begun(policy: Small, seed: int, **options: Any) -> Any:
    session = AgentCopies(policy).make()
    session.reset(at(seed), None, seed=seed, **options)
    return session


def three(tmp_path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Save adapters of different ranks and layers, and return them."""
    made = {
        "stack": pairs(network(tmp_path), LAYERS, 4, seed=1),
        "pour": pairs(network(tmp_path), LAYERS, 2, seed=2),
        "fold": pairs(network(tmp_path), LAYERS[3:], 8, seed=3),
    }
    for name, values in made.items():
        save(tmp_path / name, values)
    return made


def paths(tmp_path: Path, *names: str) -> dict[str, str]:
    return {name: str(tmp_path / name) for name in names}


def test_each_row_of_one_pass_acts_as_its_adapter_merged_alone(tmp_path: Path) -> None:
    made = three(tmp_path)
    policy = loaded(tmp_path, adapters=paths(tmp_path, *made))
    chosen = ["stack", None, "pour", "fold", "stack", "fold"]
    sessions = [begun(policy, seed, adapter=name) for seed, name in enumerate(chosen)]
    policy.passes.clear()
    acts = policy.act_batch(
        [at(seed, **{SAMPLES: seed % 3}) for seed in range(len(chosen))], sessions
    )
    assert policy.passes == [len(chosen) + sum(seed % 3 for seed in range(len(chosen)))]
    for seed, (name, act) in enumerate(zip(chosen, acts, strict=True)):
        alone = loaded(tmp_path)
        plain = begun(alone, seed).act(at(seed)).action
        if name is not None:
            merge(alone.model, made[name])
        wanted = begun(alone, seed).act(at(seed, **{SAMPLES: seed % 3}))
        assert isinstance(act, Act)
        np.testing.assert_allclose(act.action, wanted.action, rtol=RTOL, atol=RTOL)
        assert name is None or np.abs(act.action - plain).max() > 0.1  # the adapter has an effect
        if seed % 3:
            np.testing.assert_allclose(
                act.info[DISTRIBUTION]["samples"],
                wanted.info[DISTRIBUTION]["samples"],
                rtol=RTOL,
                atol=RTOL,
            )


def test_passes_of_two_threads_each_have_the_adapters_of_their_rows(tmp_path: Path) -> None:
    made, found = three(tmp_path), dict[str, np.ndarray]()
    policy, barrier = (
        loaded(tmp_path, adapters=paths(tmp_path, *made)),
        threading.Barrier(2, timeout=60),
    )

    def meet(*_: Any) -> None:
        barrier.wait()  # both threads are in a pass

    def act(name: str) -> None:
        found[name] = begun(policy, 0, adapter=name).act(at(0)).action

    wanted = {name: begun(policy, 0, adapter=name).act(at(0)).action for name in ("stack", "pour")}
    # Without isolation, both threads would use one thread's adapters in these layers.
    for place in (0, 2):
        policy.model["head"][place].register_forward_pre_hook(meet)
    threads = [threading.Thread(target=act, args=[name]) for name in wanted]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for name, actions in wanted.items():
        np.testing.assert_array_equal(found[name], actions)


def test_sessions_without_an_adapter_act_as_the_base_to_the_bit(tmp_path: Path) -> None:
    three(tmp_path)
    wanted = begun(loaded(tmp_path), 5).act(at(5)).action
    policy = loaded(tmp_path, adapters=paths(tmp_path, "stack", "pour"), batch_sizes=[4])
    mixed = policy.act_batch([at(5), at(6)], [begun(policy, 5), begun(policy, 6, adapter="stack")])
    single = loaded(tmp_path, batch_sizes=[4])
    assert isinstance(mixed[0], Act)
    assert np.array_equal(mixed[0].action, begun(single, 5).act(at(5)).action)
    np.testing.assert_allclose(mixed[0].action, wanted, rtol=RTOL, atol=RTOL)


def test_acts_and_resets_say_which_adapter_it_was(tmp_path: Path) -> None:
    three(tmp_path)
    policy = loaded(tmp_path, adapters=paths(tmp_path, "stack", "pour"))
    said = {
        name: begun(policy, 0, adapter=name).act(at(0)).info.get(POLICY)
        for name in (None, "stack", "pour")
    }
    assert policy.weights_id is not None
    assert said[None] == {
        "version": 0,
        "fingerprint": policy.weights_id["digest"].rpartition(":")[2][:16],
    }
    assert said["stack"]["fingerprint"] != said["pour"]["fingerprint"]
    ids = policy.weights_id["adapters"]
    for name in ("stack", "pour"):
        info = begun(policy, 0).reset(at(0), None, adapter=name)
        assert info == {"checkpoint": str(tmp_path / name), "weights": ids[name], "revision": None}
        assert said[name]["fingerprint"] in ids[name]
    assert "weights" not in begun(policy, 0).reset(at(0), None)
    without = loaded(tmp_path, adapters=paths(tmp_path, "pour"))
    assert without.weights_id is not None
    # An additional adapter changes nothing.
    assert without.weights_id["adapters"] == {"pour": ids["pour"]}
    assert without.weights_id["digest"] == policy.weights_id["digest"]


def test_another_base_makes_another_fingerprint(tmp_path: Path) -> None:
    three(tmp_path)
    policy = loaded(tmp_path, adapters=paths(tmp_path, "stack"))
    (tmp_path / "base" / "weights.bin").write_bytes(b"other")
    other = Small.from_config(
        {"checkpoint": str(tmp_path / "base"), "adapters": paths(tmp_path, "stack")}
    )
    other.initialize()
    assert other.weights_id is not None
    assert policy.weights_id is not None
    assert other.weights_id["adapters"] != policy.weights_id["adapters"]


def test_a_session_without_its_adapter_here_is_unknown(tmp_path: Path) -> None:
    three(tmp_path)
    policy = loaded(tmp_path, adapters=paths(tmp_path, "stack", "pour"))
    here, there = begun(policy, 0, adapter="pour"), begun(policy, 1, adapter="stack")
    left = loaded(tmp_path, adapters=paths(tmp_path, "pour"))
    kept, gone = left.act_batch([at(0), at(1)], [here, there])
    assert isinstance(kept, Act)
    assert isinstance(gone, UnknownSession)


def test_an_adapter_that_is_not_offered_is_refused_with_what_is(tmp_path: Path) -> None:
    three(tmp_path)
    policy = loaded(tmp_path, adapters=paths(tmp_path, "stack", "pour"))
    with pytest.raises(
        UnknownCheckpoint,
        match=r"expected one of \['pour', 'stack'\], or none for the base, got 'fold'",
    ):
        begun(policy, 0, adapter="fold")


@pytest.mark.parametrize("setting", [{"compile": True}, {"quantization": "int8"}])
def test_what_needs_one_set_of_weights_is_refused(tmp_path: Path, setting: dict[str, Any]) -> None:
    with pytest.raises(
        ConfigError, match=f"adapters and {next(iter(setting))}: expected one of the two, got both"
    ):
        Small.from_config({"checkpoint": "any", "adapters": {"stack": "any"}, **setting})


def test_a_family_without_adapters_says_so(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match="adapters: Plain does not offer them; merge each into its base"
    ):
        Plain.from_config({"checkpoint": "any", "adapters": {"stack": "any"}})


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
        ({"base_model_name_or_path": "other/base"}, None),
    ],
)
def test_another_kind_of_adapter_is_refused(
    tmp_path: Path, config: dict[str, Any], says: str | None
) -> None:
    save(tmp_path / "stack", pairs(network(tmp_path), LAYERS, 2), **config)
    if says is None:  # a local folder may be a copy of a repository on the hub
        loaded(tmp_path, adapters=paths(tmp_path, "stack"))
        return
    with pytest.raises(ConfigError, match=f"adapter 'stack': .*{says}"):
        loaded(tmp_path, adapters=paths(tmp_path, "stack"))


def test_rank_stabilised_adapters_have_their_own_scale(tmp_path: Path) -> None:
    values = pairs(network(tmp_path), LAYERS, 4)
    save(tmp_path / "stack", values, use_rslora=True, lora_alpha=3)
    policy, alone = loaded(tmp_path, adapters=paths(tmp_path, "stack")), loaded(tmp_path)
    merge(alone.model, values, scale=3 / 2)
    got = begun(policy, 0, adapter="stack").act(at(0)).action
    np.testing.assert_allclose(got, begun(alone, 0).act(at(0)).action, rtol=RTOL, atol=RTOL)


def broken(values: dict[str, np.ndarray], what: str) -> dict[str, np.ndarray]:
    first = "base_model.model.see.lora_A.weight"
    changes: dict[str, dict[str, Any]] = {
        "unknown": {"base_model.model.eye.lora_A.weight": np.ones((2, 4), np.float32)}
        | {"base_model.model.eye.lora_B.weight": np.ones((8, 2), np.float32)},
        "half": {"base_model.model.head.1.lora_A.weight": np.ones((2, 4), np.float32)},
        "shape": {first: np.ones((2, 5), np.float32)},
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
    with pytest.raises(ConfigError, match=f"adapter 'stack': .*{says}"):
        loaded(tmp_path, adapters=paths(tmp_path, "stack"))


def test_values_of_the_base_beside_an_adapter_may_only_be_the_same(tmp_path: Path) -> None:
    made = network(tmp_path)
    values = pairs(made, LAYERS, 2)
    same = {"base_model.model.see.base_layer.weight": made["see"].weight.detach().numpy().copy()}
    save(tmp_path / "stack", values | same)
    save(tmp_path / "plain", values)
    policy = loaded(tmp_path, adapters=paths(tmp_path, "stack", "plain"))
    got, wanted = (begun(policy, 0, adapter=name).act(at(0)).action for name in ("stack", "plain"))
    assert np.array_equal(got, wanted)


def test_a_truncated_or_absent_file_is_refused(tmp_path: Path) -> None:
    folder = save(tmp_path / "stack", pairs(network(tmp_path), LAYERS, 2))
    file = folder / "adapter_model.safetensors"
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(
        ConfigError, match=r"adapter 'stack': .*is damaged, or has a different format"
    ):
        loaded(tmp_path, adapters=paths(tmp_path, "stack"))
    file.rename(folder / "adapter_model.bin")  # a pickle, according to its name
    with pytest.raises(
        ConfigError, match=r"adapter 'stack': .*expected \['adapter_model.safetensors'\] in it"
    ):
        loaded(tmp_path, adapters=paths(tmp_path, "stack"))


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
            r"adapter 'stack': .*expected an adapter of '.*base', the policy's checkpoint, got "
            r"one trained on '.*other'"
        ),
    ):
        loaded(tmp_path, adapters=paths(tmp_path, "stack"))
    (other / "weights.bin").write_bytes(b"base")  # a copy of the base
    loaded(tmp_path, adapters=paths(tmp_path, "stack"))
    config = json.loads((folder / "adapter_config.json").read_text())
    (folder / "adapter_config.json").write_text(
        json.dumps(config | {"base_model_name_or_path": str(tmp_path / "base")})
    )
    loaded(tmp_path, adapters=paths(tmp_path, "stack"))


def test_a_file_of_the_folder_is_not_the_adapter(tmp_path: Path) -> None:
    folder = save(tmp_path / "stack", pairs(network(tmp_path), LAYERS, 2))
    with pytest.raises(
        ConfigError,
        match=r"adapter 'stack': .*expected the folder with adapter_config.json.*, got a file",
    ):
        loaded(tmp_path, adapters={"stack": str(folder / "adapter_model.safetensors")})


@pytest.mark.parametrize("named", ["/" + 300 * "a", "~nobody_here/base", "\0"])
def test_a_base_that_cannot_be_looked_up_is_unknown(tmp_path: Path, named: str) -> None:
    save(tmp_path / "stack", pairs(network(tmp_path), LAYERS, 2), base_model_name_or_path=named)
    loaded(tmp_path, adapters=paths(tmp_path, "stack"))


@pytest.mark.parametrize(
    "content", ["[" * 100_000, '{"peft_type": "LORA", "base_model_name_or_path": 3}', "\0"]
)
def test_a_damaged_config_is_refused(tmp_path: Path, content: str) -> None:
    folder = save(tmp_path / "stack", pairs(network(tmp_path), LAYERS, 2))
    (folder / "adapter_config.json").write_text(content)
    with pytest.raises(ConfigError, match="adapter 'stack': "):
        loaded(tmp_path, adapters=paths(tmp_path, "stack"))


def test_values_are_scaled_before_they_are_rounded(tmp_path: Path) -> None:
    small = network(tmp_path).half()
    values = pairs(small, LAYERS, 2)
    tiny = {
        name: value * np.float32(1e-9) if ".lora_B." in name else value
        for name, value in values.items()
    }
    folder, x = (
        save(tmp_path / "tiny", tiny, lora_alpha=2e9),
        small["see"].weight.new_tensor(np.eye(DIM)),
    )
    adapters, plain = LoraAdapters(), small["see"](x)
    adapters.load(
        small,
        {"tiny": str(folder)},
        lambda source: (LoraAdapter(source, "a", "a"), folder),
        lambda *_: None,
    )
    with adapters.rows([adapters.find("tiny").fingerprint] * DIM):
        change = small["see"](x) - plain
    down, up = (values[f"base_model.model.see.lora_{part}.weight"] for part in "AB")
    np.testing.assert_allclose(change.detach().numpy(), (up @ down).T, atol=4e-3)
    huge = save(tmp_path / "huge", values, lora_alpha=2e6)
    with pytest.raises(
        ConfigError, match=r"expected values that are finite as torch\.float16, got NaN or infinity"
    ):
        read_adapter(huge, small)
