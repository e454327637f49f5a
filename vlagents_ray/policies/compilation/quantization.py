"""`quantization`: the weights of a model's linear layers in 8 bits, by torchao.

What an `act` reads from memory is mostly these weights, and a GPU computes a small batch as fast as it reads them.
Activations, and everything that is not a linear layer, keep the model's type.
"""

from __future__ import annotations

from operator import attrgetter
from typing import Any, Literal

from vlagents_ray.errors import ConfigError, NotTrainable
from vlagents_ray.registry import require

Quantization = Literal["int8", "float8"]

_CONFIGS: dict[Quantization, str] = {"int8": "Int8WeightOnlyConfig", "float8": "Float8WeightOnlyConfig"}


def quantize(policy: Any, kind: Quantization) -> None:
    """Replace the weights of all linear layers of a loaded policy's network, in place.

    Args:
        policy: The policy; its `network` names the attribute that is a torch module, on the device of its forward pass.
        kind: "int8", with a scale for each output of a layer, or "float8", of four bits of exponent and three of
            mantissa.

    Raises:
        ConfigError: The policy names no network, or torchao cannot quantize it here.
        MissingDependency: torchao is not installed.
    """
    if policy.network is None:
        raise ConfigError(f"quantization: {type(policy).__name__} does not offer it; leave it out")
    torchao = require("torchao.quantization")
    try:
        torchao.quantize_(attrgetter(policy.network)(policy), getattr(torchao, _CONFIGS[kind])())
    except (RuntimeError, AttributeError, NotImplementedError, AssertionError) as error:
        raise ConfigError(
            f"quantization {kind!r}: torchao cannot use it here ({type(error).__name__}: {error}); try the other one, "
            f"or dtype: bfloat16"
        ) from error


def require_whole(kind: Quantization | None) -> None:
    """Raise `NotTrainable` if weights are quantized, since a learner's weights are not."""
    if kind is not None:
        raise NotTrainable(f"quantization {kind!r}: weights of 8 bits cannot be replaced by a learner's; leave it out")
