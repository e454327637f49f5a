"""The imports of the steps of `benchmarks.gpu`: the steps' processes are forked from a process that
has imported this module.

Nothing here may initialize CUDA, which does not survive a fork.
"""

from __future__ import annotations

from contextlib import suppress

import benchmarks.gpu.runner
import benchmarks.gpu.steps  # noqa: F401

with suppress(ImportError):  # the steps report missing packages
    import torch  # noqa: F401

    from vlagents_ray.policies.base.accelerator import ensure_torchvision

    ensure_torchvision()
    import transformers.models.pi0.image_processing_pi0
    import transformers.models.pi0.modeling_pi0
    import transformers.models.pi0.processing_pi0  # noqa: F401
