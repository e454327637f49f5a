"""π0 with merged products, as on a GPU: queries, keys and values in one, gate and up in one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pushed_weights import check_pushed_weights
from safetensors.torch import load_file, save_file

from plugins.vlagents_ray_models.tests.families.pi0 import tiny
from plugins.vlagents_ray_models.tests.families.pi0.conftest import BATCHED, begun, made, seen
from vlagents_ray.policies.base import policy as base_policy
from vlagents_ray.policies.loading import LoadingReport
from vlagents_ray.weights import trainable
from vlagents_ray_models.pi0 import Pi0


def merged(folder: Path, **config: Any) -> Pi0:
    policy = made(folder, **config)
    policy.merge_products()
    return policy


def acted(policy: Pi0) -> np.ndarray:
    action = begun(policy, 0).act(seen(0)).action
    assert action is not None
    return np.asarray(action)


@pytest.mark.parametrize(("dtype", "atol"), [("float32", BATCHED), ("bfloat16", 0.02)])
def test_actions_are_those_of_single_products(folder: Path, dtype: str, atol: float) -> None:
    np.testing.assert_allclose(
        acted(merged(folder, dtype=dtype)), acted(made(folder, dtype=dtype)), atol=atol
    )


def test_names_shapes_and_values_of_the_weights_stay(folder: Path) -> None:
    before, after = made(folder).parameters(), merged(folder).parameters()
    assert list(before) == list(after)
    for name, value in before.items():
        torch.testing.assert_close(after[name], value, rtol=0, atol=0)
        assert after[name].is_contiguous()
    assert trainable.are_apart(after)


def test_it_acts_with_weights_that_are_pushed_into_the_memory_of_a_gpu(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trainable, "_on_gpu", lambda _: True)
    policy = merged(folder)
    check_pushed_weights(policy, lambda: acted(policy))


def test_it_acts_with_the_weights_of_a_file_that_is_loaded_into_it(
    folder: Path, tmp_path: Path
) -> None:
    other = made(tiny.save(tmp_path / "other", seed=1))
    weights = other.loaded().network.state_dict()
    save_file({name: value.clone() for name, value in weights.items()}, tmp_path / "weights")

    policy = merged(folder)
    network = policy.loaded().network
    network.load_state_dict(load_file(tmp_path / "weights"))
    np.testing.assert_allclose(acted(policy), acted(other), atol=BATCHED)

    save_file({name: network.state_dict()[name].clone() for name in weights}, tmp_path / "again")
    for name, value in load_file(tmp_path / "again").items():
        torch.testing.assert_close(value, weights[name], rtol=0, atol=0)


@pytest.mark.parametrize(("settings", "is_merged"), [({}, True), ({"quantization": "int8"}, False)])
def test_single_layers_stay_apart_for_quantization(
    folder: Path, monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any], is_merged: bool
) -> None:
    calls: list[Pi0] = []

    def note_call(policy: Pi0) -> None:
        calls.append(policy)

    monkeypatch.setattr(Pi0, "merge_products", note_call)
    monkeypatch.setattr(Pi0, "_warm_up", lambda _, **__: None)
    monkeypatch.setattr(base_policy, "quantize", lambda *_: None)
    made(folder, **settings)
    assert calls == []  # a CPU's weights are replaced by pushes

    monkeypatch.setattr(LoadingReport, "accelerated", True)
    made(folder, **settings)
    assert len(calls) == is_merged
