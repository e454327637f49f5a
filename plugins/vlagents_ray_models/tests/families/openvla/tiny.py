"""Tiny checkpoints with random weights, made with OpenVLA's own code: `python tiny.py OUT_FOLDER
[KIND]`.

Kinds: openvla, remote (with the code beside the weights), oft, oft-diffusion, oft-film, oft-tokens.
They need $OPENVLA_SRC, the OFT ones $OPENVLA_OFT_SRC too.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import torch

from benchmarks.checkpoints import openvla as recipe
from plugins.vlagents_ray_models.tests.families.openvla.upstream import module

KINDS = ("openvla", "remote", "oft", "oft-diffusion", "oft-film", "oft-tokens")
DATASETS = ("bridge_orig", "libero_spatial_no_noops")
# OFT's constants for LIBERO.
ACTION_DIM, PROPRIO_DIM, CHUNK = recipe.ACTION_DIM, recipe.PROPRIO_DIM, 8
VOCABULARY = recipe.VOCABULARY
LLM_DIM = 32
DIFFUSION_STEPS = 5
LORA_RANK = 4  # as scale min(rank, 16) / rank = 1


def make(folder: Path, kind: str = "openvla", datasets: tuple[str, ...] = DATASETS) -> Path:
    """Write a checkpoint of that kind into `folder`."""
    torch.manual_seed(0)
    variable = "OPENVLA_OFT_SRC" if kind.startswith("oft") else "OPENVLA_SRC"
    network = _network(variable, small=kind != "openvla")
    network.save_pretrained(folder)
    processor = module(variable, "extern.hf.processing_prismatic").PrismaticImageProcessor
    recipe.make_image_processor(processor, side=64).save_pretrained(folder)
    recipe.make_tokenizer().save_pretrained(folder)
    (folder / "dataset_statistics.json").write_text(json.dumps(recipe.make_statistics(datasets)))
    if kind == "remote":
        _add_code(folder)
    elif kind.startswith("oft"):
        _add_components(folder, kind, network)
    return folder


def _network(variable: str, *, small: bool) -> Any:
    """Return the model, whose two backbones return 16 patches each.

    The first one of the larger has layer scales, whose name transformers would change if OpenVLA
    did not.
    """
    modeling = module(variable, "extern.hf.modeling_prismatic")
    text = {
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "initializer_range": 0.3,
    }
    size = recipe.PrismaticSize(
        {"hidden_size": LLM_DIM, **text},
        ("vit_tiny_patch16_224" if small else "deit3_small_patch16_224", "vit_tiny_patch16_224"),
        side=64,
    )
    # Far from zero, so that different inputs have different actions.
    config = recipe.make_config(modeling.OpenVLAConfig, size, initializer_range=0.1)
    network = modeling.OpenVLAForActionPrediction(config).eval()
    for name, parameter in network.named_parameters():
        if "scale_factor" in name:
            torch.nn.init.normal_(parameter)
    recipe.answer_with_actions(network.language_model.lm_head.weight.data)
    return network


def _add_code(folder: Path) -> None:
    """Add the model's code to a checkpoint, and name its classes in the configs."""
    hf = Path(module("OPENVLA_SRC", "extern.hf.modeling_prismatic").__file__ or "").parent
    for name in ("configuration", "modeling", "processing"):
        shutil.copy(hf / f"{name}_prismatic.py", folder)
    auto_maps = {
        "config.json": {"AutoModelForVision2Seq": "modeling_prismatic.OpenVLAForActionPrediction"},
        "preprocessor_config.json": {
            "AutoImageProcessor": "processing_prismatic.PrismaticImageProcessor"
        },
    }
    for name, auto_map in auto_maps.items():
        config = json.loads((folder / name).read_text())
        (folder / name).write_text(json.dumps(config | {"auto_map": auto_map}))


def _add_components(folder: Path, kind: str, network: Any) -> None:
    """Add the components that OFT's fine-tuning saves."""
    heads = module("OPENVLA_OFT_SRC", "models.action_heads")
    projectors = module("OPENVLA_OFT_SRC", "models.projectors")
    components: dict[str, torch.nn.Module] = {
        "proprio_projector": projectors.ProprioProjector(LLM_DIM, PROPRIO_DIM)
    }
    if kind == "oft-diffusion":
        components["action_head"] = heads.DiffusionActionHead(
            LLM_DIM, LLM_DIM, ACTION_DIM, DIFFUSION_STEPS
        )
        components["noisy_action_projector"] = projectors.NoisyActionProjector(LLM_DIM)
    elif kind != "oft-tokens":
        components["action_head"] = heads.L1RegressionActionHead(LLM_DIM, LLM_DIM, ACTION_DIM)
    if kind == "oft-film":
        components["vision_backbone"] = filmed(network)

    for name, component in components.items():
        state = component.state_dict()
        if name in ("action_head", "proprio_projector"):  # trained in parallel
            state = {f"module.{key}": tensor for key, tensor in state.items()}
        torch.save(state, folder / f"{name}--100_checkpoint.pt")


def filmed(network: Any, *, trained: bool = True) -> torch.nn.Module:
    """The network's vision backbone with LoRA and FiLM, as OFT+ trains it; untrained adapters
    change nothing.
    """
    from peft import LoraConfig, get_peft_model

    config = LoraConfig(
        r=LORA_RANK,
        lora_alpha=LORA_RANK,
        target_modules="all-linear",
        init_lora_weights=False if trained else "gaussian",
    )
    adapted = get_peft_model(network, config).model
    film = module("OPENVLA_OFT_SRC", "models.film_vit_wrapper")
    return film.FiLMedPrismaticVisionBackbone(
        vision_backbone=adapted.vision_backbone, llm_dim=LLM_DIM
    )


if __name__ == "__main__":
    make(Path(sys.argv[1]), *sys.argv[2:3])
