"""LoRA adapters: many fine-tunes of one network in one forward pass, each row of a batch with its own."""

from vlagents_ray.policies.adapters.adapters import ADAPTER, Adapter, Adapters, require_base_alone
from vlagents_ray.policies.adapters.peft_folder import FILES, base_of

__all__ = ["ADAPTER", "FILES", "Adapter", "Adapters", "base_of", "require_base_alone"]
