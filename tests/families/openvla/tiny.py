"""Tiny checkpoints with random weights, made with OpenVLA's own code: `python tiny.py OUT_FOLDER [KIND]`.

Kinds: openvla, remote (with the code beside the weights), oft, oft-diffusion, oft-film, oft-tokens. They need
$OPENVLA_SRC, the OFT ones $OPENVLA_OFT_SRC too.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors, trainers
from transformers import PreTrainedTokenizerFast

from tests.families.openvla.upstream import module

KINDS = ("openvla", "remote", "oft", "oft-diffusion", "oft-film", "oft-tokens")
DATASETS = ("bridge_orig", "libero_spatial_no_noops")
ACTION_DIM, PROPRIO_DIM, CHUNK = 7, 8, 8  # OFT's constants for LIBERO
LLM_DIM = 32
VOCABULARY = 32064  # Llama's 32000 and one for padding, in multiples of 64: action tokens count from its end
DIFFUSION_STEPS = 5
LORA_RANK = 4  # as scale min(rank, 16) / rank = 1
SENTENCES = (
    "In: What action should the robot take to pick up the black bowl?\nOut:",
    "open the top drawer of a cabinet",
)


def make(folder: Path, kind: str = "openvla", datasets: tuple[str, ...] = DATASETS) -> Path:
    """A checkpoint of that kind in `folder`."""
    torch.manual_seed(0)
    variable = "OPENVLA_OFT_SRC" if kind.startswith("oft") else "OPENVLA_SRC"
    network = _network(variable, small=kind != "openvla")
    network.save_pretrained(folder)
    processor = module(variable, "extern.hf.processing_prismatic").PrismaticImageProcessor(
        use_fused_vision_backbone=True,
        image_resize_strategy="resize-naive",
        input_sizes=[(3, 64, 64), (3, 64, 64)],
        interpolations=["bicubic", "bicubic"],
        means=[(0.485, 0.456, 0.406), (0.5, 0.5, 0.5)],
        stds=[(0.229, 0.224, 0.225), (0.5, 0.5, 0.5)],
    )
    processor.save_pretrained(folder)
    _tokenizer().save_pretrained(folder)
    (folder / "dataset_statistics.json").write_text(json.dumps({name: _statistics(name) for name in datasets}))
    if kind == "remote":
        _add_code(folder)
    elif kind.startswith("oft"):
        _add_components(folder, kind, network)
    return folder


def _network(variable: str, *, small: bool) -> Any:
    """The model, whose two backbones give 16 patches each.

    The first one of the larger has layer scales, whose name transformers would change if OpenVLA did not.
    """
    modeling = module(variable, "extern.hf.modeling_prismatic")
    config = modeling.OpenVLAConfig(
        vision_backbone_id="dinosiglip-vit-so-224px",
        llm_backbone_id="llama2-7b-pure",
        arch_specifier="no-align+fused-gelu-mlp",
        use_fused_vision_backbone=True,
        text_config={
            "hidden_size": LLM_DIM,
            "intermediate_size": 64,
            "num_hidden_layers": 2,
            "num_attention_heads": 4,
            "vocab_size": VOCABULARY,
            "pad_token_id": 32000,
            "initializer_range": 0.3,
        },
        # in the JSON these go before what the id stands for
        timm_model_ids=["vit_tiny_patch16_224" if small else "deit3_small_patch16_224", "vit_tiny_patch16_224"],
        image_sizes=[64, 64],
        initializer_range=0.1,  # far from nothing, so that different inputs have different answers
        n_action_bins=256,
    )
    network = modeling.OpenVLAForActionPrediction(config).eval()
    for name, parameter in network.named_parameters():
        if "scale_factor" in name:
            torch.nn.init.normal_(parameter)
    bins = slice(VOCABULARY - 64 - 256, VOCABULARY - 64)
    likely = torch.zeros_like(network.language_model.lm_head.weight)
    likely[bins] = network.language_model.lm_head.weight[bins].detach()
    network.language_model.lm_head.weight.data = likely  # a trained model answers with action tokens
    return network


def _tokenizer() -> PreTrainedTokenizerFast:
    special = {"unk_token": "<unk>", "bos_token": "<s>", "eos_token": "</s>"}  # with Llama's numbers, 0, 1, 2
    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=400,
        special_tokens=list(special.values()),
        initial_alphabet=pre_tokenizers.ByteLevel.alphabet(),
        show_progress=False,
    )
    tokenizer.train_from_iterator(SENTENCES, trainer)
    tokenizer.post_processor = processors.TemplateProcessing(single="<s> $A", special_tokens=[("<s>", 1)])
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        **special,
        model_input_names=["input_ids", "attention_mask"],  # as Llama's
    )


def _statistics(name: str) -> dict[str, Any]:
    rng = np.random.default_rng(len(name))
    return {
        "action": _ranges(rng, ACTION_DIM) | {"mask": [True] * (ACTION_DIM - 1) + [False]},
        "proprio": _ranges(rng, PROPRIO_DIM),
    }


def _ranges(rng: np.random.Generator, dim: int) -> dict[str, Any]:
    middle, reach = rng.normal(size=dim), rng.uniform(0.5, 2, dim)
    return {
        "q01": (middle - reach).tolist(),
        "q99": (middle + reach).tolist(),
        "min": (middle - 2 * reach).tolist(),
        "max": (middle + 2 * reach).tolist(),
    }


def _add_code(folder: Path) -> None:
    """The model's code beside its weights, and where it is found."""
    hf = Path(module("OPENVLA_SRC", "extern.hf.modeling_prismatic").__file__ or "").parent
    for name in ("configuration", "modeling", "processing"):
        shutil.copy(hf / f"{name}_prismatic.py", folder)
    named = {
        "config.json": {"AutoModelForVision2Seq": "modeling_prismatic.OpenVLAForActionPrediction"},
        "preprocessor_config.json": {"AutoImageProcessor": "processing_prismatic.PrismaticImageProcessor"},
    }
    for name, auto_map in named.items():
        config = json.loads((folder / name).read_text())
        (folder / name).write_text(json.dumps(config | {"auto_map": auto_map}))


def _add_components(folder: Path, kind: str, network: Any) -> None:
    """OFT's heads, as its fine-tuning saves them."""
    heads = module("OPENVLA_OFT_SRC", "models.action_heads")
    projectors = module("OPENVLA_OFT_SRC", "models.projectors")
    parts: dict[str, torch.nn.Module] = {"proprio_projector": projectors.ProprioProjector(LLM_DIM, PROPRIO_DIM)}
    if kind == "oft-diffusion":
        parts["action_head"] = heads.DiffusionActionHead(LLM_DIM, LLM_DIM, ACTION_DIM, DIFFUSION_STEPS)
        parts["noisy_action_projector"] = projectors.NoisyActionProjector(LLM_DIM)
    elif kind != "oft-tokens":
        parts["action_head"] = heads.L1RegressionActionHead(LLM_DIM, LLM_DIM, ACTION_DIM)
    if kind == "oft-film":
        parts["vision_backbone"] = filmed(network)
    for name, part in parts.items():
        state = part.state_dict()
        if name in ("action_head", "proprio_projector"):  # trained in parallel
            state = {f"module.{key}": tensor for key, tensor in state.items()}
        torch.save(state, folder / f"{name}--100_checkpoint.pt")


def filmed(network: Any, *, trained: bool = True) -> torch.nn.Module:
    """The network's vision backbone with LoRA and FiLM, as OFT+ trains it; untrained adapters change nothing."""
    from peft import LoraConfig, get_peft_model

    config = LoraConfig(
        r=LORA_RANK,
        lora_alpha=LORA_RANK,
        target_modules="all-linear",
        init_lora_weights=False if trained else "gaussian",
    )
    adapted = get_peft_model(network, config).model
    film = module("OPENVLA_OFT_SRC", "models.film_vit_wrapper")
    return film.FiLMedPrismaticVisionBackbone(vision_backbone=adapted.vision_backbone, llm_dim=LLM_DIM)


if __name__ == "__main__":
    make(Path(sys.argv[1]), *sys.argv[2:3])
