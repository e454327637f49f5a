"""The action-conditioned predictor, with upstream's code."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError, MissingDependency
from vlagents_ray.policies.base.checkpoint import find_checkpoint, require_loaded
from vlagents_ray.policies.base.model_code import use_source
from vlagents_ray.policies.vjepa2_ac.config import VJepa2AcConfig
from vlagents_ray.registry import require

_PREFIXES = ("module.", "backbone.")  # added by distributed training and upstream's wrapper


def read_checkpoint(config: VJepa2AcConfig) -> dict[str, dict[str, Any]]:
    """Read the tensors of the parts of upstream's file, "encoder" and "predictor"; nothing is unpickled."""
    torch = require("torch")
    path = find_checkpoint(config.checkpoint, config.checkpoint_step, needs=("*.pt",))
    file = path if path.is_file() else _only(path)
    try:
        parts = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # it may not be a zip file, or a pickle of other types
        raise ConfigError(
            f"checkpoint {file}: not a file of tensors ({type(error).__name__}); want upstream's .pt"
        ) from error
    if not isinstance(parts, Mapping) or not isinstance(parts.get("predictor"), Mapping):
        got = sorted(map(str, parts))[:8] if isinstance(parts, Mapping) else type(parts).__name__
        raise ConfigError(
            f"checkpoint {file}: got {got}, want 'predictor' among them; is it V-JEPA 2-AC's, and not V-JEPA 2's?"
        )
    return {name: _clean(part) for name, part in parts.items() if isinstance(part, Mapping)}


def load_predictor(config: VJepa2AcConfig, saved: Mapping[str, Any], width: int) -> Any:
    """Load the predictor; raises `ConfigError` if its code or a weight is missing, or the encoder does not fit."""
    use_source("src", "VJEPA2_SRC", config.source_dir)
    try:
        module = importlib.import_module("src.models.ac_predictor")
    except ModuleNotFoundError as error:
        raise MissingDependency(
            f"the predictor's code cannot be imported: no module {error.name!r}; is `src` vjepa2's, and timm installed?"
        ) from error
    embedding = saved.get("predictor_embed.weight")
    if embedding is None or embedding.shape[1] != width:
        got = (
            "no 'predictor_embed.weight'" if embedding is None else f"a predictor of features {embedding.shape[1]} wide"
        )
        raise ConfigError(
            f"checkpoint {config.checkpoint!r}: got {got}, want {width}, the encoder's; they belong together"
        )
    model = module.vit_ac_predictor(
        img_size=(config.image_size, config.image_size),
        num_frames=2 * config.rollout,  # tubelets have two frames; this sets the mask's size only
        tubelet_size=2,
        embed_dim=width,
        predictor_embed_dim=embedding.shape[0],
        depth=len({name.split(".")[1] for name in saved if name.startswith("predictor_blocks.")}),
        num_heads=config.predictor_heads,
    )
    try:
        model.load_state_dict(saved)
    except RuntimeError as error:
        raise ConfigError(
            f"checkpoint {config.checkpoint!r}: its predictor does not fit: {str(error)[:500]}"
        ) from error
    require_loaded(model, saved)
    return model


@contextmanager
def usual_attention() -> Iterator[None]:
    """Have upstream's attention use torch's choice of a kernel as it is.

    Upstream sets that choice to torch's default for each layer, by a deprecated function that cannot be compiled.
    """
    backend = require("torch").backends.cuda
    setter, backend.sdp_kernel = backend.sdp_kernel, nullcontext
    try:
        yield
    finally:
        backend.sdp_kernel = setter


def _only(folder: Path) -> Path:
    files = sorted(folder.glob("*.pt"))
    if len(files) != 1:
        raise ConfigError(f"checkpoint {folder}: got {[file.name for file in files]}, want one .pt file; name it")
    return files[0]


def _clean(part: Mapping[str, Any]) -> dict[str, Any]:
    """Rename tensors to the names of the model itself."""
    cleaned = {}
    for name, tensor in part.items():
        for prefix in _PREFIXES:
            name = str(name).replace(prefix, "")  # noqa: PLW2901 - step by step
        cleaned[str(name)] = tensor
    return cleaned
