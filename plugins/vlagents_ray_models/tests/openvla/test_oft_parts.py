"""The components that fine-tuning added to OpenVLA-OFT, as a learner pushes them, with a stand-in
for the network.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from pushed_weights import check_pushed_weights

from vlagents_ray.errors import ConfigError
from vlagents_ray_models.openvla.oft import Mlp, OpenVLAOFT, OpenVLAOFTConfig, Parallel, Projector

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.torch

WIDTH, DIM = 6, 2  # of hidden states, of actions


def random_layers(prefix: str, shapes: dict[str, tuple[int, ...]]) -> dict[str, Any]:
    """Return random weights and biases of layers, by their names in upstream's files."""
    generator = torch.Generator().manual_seed(0)
    tensors = {}
    for layer, shape in shapes.items():
        tensors[f"{prefix}{layer}.weight"] = torch.randn(shape, generator=generator)
        tensors[f"{prefix}{layer}.bias"] = torch.randn(shape[:1], generator=generator)
    return tensors


@pytest.fixture(params=["model", "noise_predictor.mlp_resnet"])
def policy(request: pytest.FixtureRequest) -> OpenVLAOFT:
    """A policy whose network is one layer."""
    norms = {f"mlp_resnet_blocks.{i}.ffn.0": (4,) for i in (0, 1)} | {
        "layer_norm1": (WIDTH,),
        "layer_norm2": (4,),
    }
    linear = {f"mlp_resnet_blocks.{i}.ffn.1": (4, 4) for i in (0, 1)} | {
        "fc1": (4, WIDTH),
        "fc2": (DIM, 4),
    }
    base: Any = SimpleNamespace(network=torch.nn.Linear(WIDTH, WIDTH))
    head = Mlp(random_layers(f"{request.param}.", norms | linear), request.param)
    proprio = Projector(
        random_layers("", {"fc1": (WIDTH, 3), "fc2": (WIDTH, WIDTH)}), "proprio_projector"
    )
    policy = OpenVLAOFT(OpenVLAOFTConfig(checkpoint="none"))
    policy.model = Parallel(
        base, horizon=1, dim=DIM, head=head, proprio=proprio, noisy=None, film=None, steps=(1, 1)
    )
    return policy


def test_it_acts_with_pushed_parts_by_the_names_of_upstreams_files(policy: OpenVLAOFT) -> None:
    model = policy.model
    assert model.head is not None
    assert model.proprio is not None
    assert model.head.dim == DIM
    names = policy.parameters().keys()
    assert {"vla/weight", "vla/bias", "proprio_projector/fc1.weight"} <= names
    assert {f"action_head/{name}" for name in model.head.weights} <= names

    def act() -> Any:
        with torch.inference_mode():
            return model.head(model.base.network(model.proprio(torch.ones(1, 3)))).numpy()

    check_pushed_weights(policy, act)


def test_an_adapter_is_rejected_since_its_head_was_trained_with_it() -> None:
    with pytest.raises(ConfigError, match="adapter: there is no such setting"):
        OpenVLAOFT.from_config({"checkpoint": "none", "adapter": "/runs/a"})
