"""A policy never acts on weights that its checkpoint does not hold."""

from __future__ import annotations

from pathlib import Path

import pytest

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.checkpoint import SavedTensors, find_checkpoint, require_loaded

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch


def test_a_step_takes_its_place_in_the_path(tmp_path: Path) -> None:
    (tmp_path / "step_2000").mkdir()
    assert find_checkpoint(f"{tmp_path}/step_{{step}}", 2000) == tmp_path / "step_2000"


def test_what_is_not_there_is_said_with_what_is(tmp_path: Path) -> None:
    (tmp_path / "step_1000").mkdir()
    with pytest.raises(ConfigError, match=r"step_2000.*step_1000"):
        find_checkpoint(f"{tmp_path}/step_{{step}}", 2000)
    with pytest.raises(ConfigError, match=r"misses \['config.json'\]"):
        find_checkpoint(str(tmp_path / "step_1000"), needs=["config.json"])


def model() -> torch.nn.Module:
    layers = torch.nn.Sequential(torch.nn.Linear(8, 8), torch.nn.BatchNorm1d(8), torch.nn.Linear(8, 8))
    layers[2].weight = layers[0].weight  # tied
    return layers


def test_a_model_that_holds_its_checkpoint_passes() -> None:
    net = model()
    saved = {name: tensor.clone() for name, tensor in net.state_dict().items()}
    require_loaded(net, saved)
    require_loaded(net, {name: tensor for name, tensor in saved.items() if name != "2.weight"})
    require_loaded(net.to(torch.bfloat16), saved)


@pytest.mark.parametrize("name", ["0.weight", "2.bias", "1.running_mean"])
def test_random_weights_missing_ones_and_wrong_shapes_are_told(name: str) -> None:
    net = model()
    saved = {key: tensor.clone() for key, tensor in net.state_dict().items()}
    for wrong in (saved[name] + 1e-3, saved[name][:4]):
        with pytest.raises(ConfigError, match=f"1 are not what it holds .*{name}|2 are not what it holds .*{name}"):
            require_loaded(net, saved | {name: wrong})
    tied = {name, "2.weight"} if name == "0.weight" else {name}
    with pytest.raises(ConfigError, match=f"are not in it .*{name}"):
        require_loaded(net, {key: tensor for key, tensor in saved.items() if key not in tied})


def test_saved_tensors_are_read_when_asked_for_and_under_other_names() -> None:
    reads: list[str] = []

    def reader(name: str) -> torch.Tensor:
        reads.append(name)
        return torch.zeros(1)

    saved = SavedTensors({name: lambda name=name: reader(name) for name in ("model.a", "model.b", "ema.a")})
    inner = saved.renamed(lambda name: name.removeprefix("model.") if name.startswith("model.") else None)
    assert sorted(inner) == ["a", "b"]
    assert reads == []
    assert inner["a"].shape == (1,)
    assert reads == ["model.a"]
