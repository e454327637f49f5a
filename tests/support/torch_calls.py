"""Count the GPU operations of an act without a GPU, on the device "meta", which computes nothing.

In eager mode, an act launches about one kernel for each ATen call that is not a view, and each call
takes some microseconds in Python. Some functions, such as attention, are a single kernel on a GPU,
but several calls on the device meta: `launches` counts each function once. A copy to the CPU, or a
value that Python reads, waits until the GPU has done all of its work so far; so does a copy of
memory that is not pinned, as in `torch.tensor(numbers, device=…)`.
"""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Sequence
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

META = torch.device("meta")
_READ = {
    "_local_scalar_dense",
    "nonzero",
    "masked_select",
    "equal",
    "is_nonzero",
    "unique_dim",
    "_unique2",
}
_ANY_DEVICE = {"aten.lift_fresh.default", "aten.detach.default"}  # calls that launch no kernel
# Functions with a single CUDA kernel, according to torch's native_functions.yaml.
_ONE_KERNEL = {"scaled_dot_product_attention", "_fused_rms_norm"}


class TorchCalls(TorchDispatchMode):
    """Counts the calls on the device meta within its context. A copy to the CPU returns zeros."""

    def __init__(self) -> None:
        super().__init__()
        self.calls = 0  # calls except views
        self.launches = 0  # the same, but a function of `_ONE_KERNEL` counts once
        self.uploads = 0  # asynchronous copies from pinned memory of the CPU
        # Number of times that Python waits for the GPU, by function.
        self.waits: Counter[str] = Counter()

    def __torch_dispatch__(self, op: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs, name = kwargs or {}, op.overloadpacket.__name__
        launches_before = self.launches
        with self:  # for tensors of inference mode, some calls arrive undecomposed
            parts = op.decompose(*args, **kwargs)
        if parts is not NotImplemented:
            if name in _ONE_KERNEL:
                self.launches = launches_before + 1
            return parts
        tensors = [one for one in tree_leaves((args, kwargs)) if isinstance(one, torch.Tensor)]
        here = any(one.device == META for one in tensors)
        if name in ("_to_copy", "copy_"):
            [source, target] = (
                (args[1], args[0].device) if name == "copy_" else (args[0], kwargs.get("device"))
            )
            if source.device == META and target is not None and target != META:
                self._wait("copy to the CPU")
                zeros = torch.zeros(source.shape, dtype=kwargs.get("dtype") or source.dtype)
                return args[0].copy_(zeros) if name == "copy_" else zeros
            if source.device != META and META in (target, getattr(args[0], "device", None)):
                self.uploads += bool(
                    kwargs.get("non_blocking") or (name == "copy_" and args[2:3] == (True,))
                )
                if not (kwargs.get("non_blocking") or (name == "copy_" and args[2:3] == (True,))):
                    self._wait("copy from the CPU")
                return op(*args, **kwargs)
        if here and name.startswith("index") and (why := _copied(args[1])):
            self._wait(f"{name} by {why}")
        if here and name in _READ:
            self._wait(name)
            if name == "_local_scalar_dense":
                return torch.zeros((), dtype=args[0].dtype).item()
        if here and name == "lift_fresh":
            self._wait("tensor of numbers")
        result = op(*args, **kwargs)
        made = here or any(
            isinstance(one, torch.Tensor) and one.device == META for one in tree_leaves(result)
        )
        is_counted = made and not op.is_view and str(op) not in _ANY_DEVICE
        self.calls += is_counted
        self.launches += is_counted
        return result

    def _wait(self, why: str) -> None:
        lines = [
            f"{frame.filename.rpartition('site-packages/')[2].rpartition('/vlagents_ray/')[2]}:{frame.name}"
            for frame in traceback.extract_stack()
            if "/torch/" not in frame.filename and "/tests/" not in frame.filename
        ]
        self.waits[f"{why} in {lines[-1] if lines else '?'}"] += 1


def calls_of_an_act(policy: Any, sessions: Sequence[Any], views: Sequence[Any]) -> TorchCalls:
    """Act once with all sessions, on their observations and prepared inputs, and return the
    counts.
    """
    for session, obs in zip(sessions, views, strict=True):
        obs.prepared = session.prepare(obs)
    with TorchCalls() as counted:
        acts = policy.act_batch(views, sessions)
    assert not [act for act in acts if isinstance(act, Exception)]
    print(
        f"{type(policy).__name__}: {counted.calls} calls, {counted.uploads} copies, waits: "
        f"{dict(counted.waits)}"
    )
    return counted


def _copied(indices: Any) -> str:
    """Return why indexing waits for the GPU: Python counts true values, or the index is a list or a
    tensor on the CPU.
    """
    given = [one for one in tree_leaves(indices) if isinstance(one, torch.Tensor)]
    if any(one.dtype in (torch.bool, torch.uint8) for one in given):
        return "truth values"
    return "numbers on the CPU" if any(one.device != META for one in given) else ""
