"""The passes of a Diffusion Policy that can be compiled: what it sees, and a step from noise to actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.diffusion_policy.network import DiffusionNetwork
from vlagents_ray.registry import require

_CONDITIONS = {"obs_as_cond": "cond", "obs_as_local_cond": "local_cond", "obs_as_global_cond": "global_cond"}


def compile_with(network: DiffusionNetwork, compilation: Compilation) -> None:
    """Have a policy's module call its denoising network, and the encoder of its images, as compiled cores.

    Args:
        network: The module, whose `predict_action` calls both, and its inputs.
        compilation: That of the policy.
    """
    module = network.module
    _without_branches_on_values(module, network.device)
    condition = next((name for flag, name in _CONDITIONS.items() if getattr(module, flag, False)), "")
    module.model.forward = _denoising(module.model.forward, condition, compilation)
    if (encoder := getattr(module, "obs_encoder", None)) is not None:
        names = [*network.images, *network.vectors]
        encoder.forward = _looking(encoder.forward, names, module.n_obs_steps, compilation)


def _denoising(forward: Callable[..., Any], condition: str, compilation: Compilation) -> Callable[..., Any]:
    """Return the denoising network as its loop calls it; `condition` is what the network calls what is seen."""

    def denoise(sample: Any, times: Any, *seen: Any) -> Any:
        return forward(sample, times, **dict(zip([condition], seen, strict=False)))

    core = compilation.core("denoise", denoise)

    def call(sample: Any, time: Any, *seen: Any, **named: Any) -> Any:
        given = [one for one in (*seen, *named.values()) if one is not None]
        return core(sample, time.to(sample.device).expand(len(sample)), *given)

    return call


def _looking(
    forward: Callable[..., Any], names: list[str], steps: int, compilation: Compilation
) -> Callable[[Mapping[str, Any]], Any]:
    """Return the encoder of frames (B * steps, …) by their names, whose core has rows of all their frames."""

    def look(*frames: Any) -> Any:
        seen = {name: frame.flatten(0, 1) for name, frame in zip(names, frames, strict=True)}
        return forward(seen).reshape(len(frames[0]), steps, -1)

    core = compilation.core("look", look)

    def call(seen: Mapping[str, Any]) -> Any:
        return core(*(seen[name].unflatten(0, (-1, steps)) for name in names)).flatten(0, 1)

    return call


def _without_branches_on_values(module: Any, device: Any) -> None:
    """Have parts of torch compute without a look at numbers, which no program can branch on."""
    torch, transforms = require("torch"), require("torchvision.transforms")
    for part in module.modules():
        if isinstance(part, transforms.Normalize):  # refuses a std of 0
            mean, std = (torch.tensor(numbers, device=device).view(-1, 1, 1) for numbers in (part.mean, part.std))
            part.forward = partial(_normalised, mean, std)
        elif isinstance(part, torch.nn.TransformerDecoder):  # compares its mask with a causal one, for a faster kernel
            part.forward = partial(part.forward, tgt_is_causal=False)
        elif isinstance(part, torch.nn.TransformerEncoder):
            part.forward = partial(part.forward, is_causal=False)


def _normalised(mean: Any, std: Any, image: Any) -> Any:
    return (image - mean) / std
