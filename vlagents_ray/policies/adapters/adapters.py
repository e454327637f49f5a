"""LoRA adapters of one network, of which each row of a batch may have another.

The weights of the network stay those of the base. After each linear layer that an adapter changes, a hook adds
B[i] A[i] x to the layer's result, where i is the adapter of x's row: two small products for all rows of the batch, with
A and B of all adapters in one tensor each. Adapters of a smaller rank are padded with zeros, and rows without one have
one of zeros. S-LoRA (arXiv 2311.03285) and Punica (arXiv 2310.18547) serve language models in this way.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError, NotTrainable, PolicyFailed, UnknownCheckpoint, UnknownSession
from vlagents_ray.interface import POLICY
from vlagents_ray.policies.adapters.peft_folder import read_adapter

ADAPTER = "adapter"  # option of a reset: the name of the session's adapter
_DIGITS = 16  # of a fingerprint, hexadecimal


@dataclass(frozen=True, slots=True)
class Adapter:
    """An adapter of a session: by default none."""

    source: str = ""  # path or hub id, as the settings name it
    weights: str = ""  # digest of the base's files and the adapter's
    fingerprint: str = ""  # the beginning of that; empty: none, the session acts with the base alone
    revision: str | None = None  # the hub's commit of the adapter

    @classmethod
    def of(cls, source: str, base: str, own: str, revision: str | None = None) -> Adapter:
        """Return the adapter with that source and commit, on a base and with files of these digests."""
        digest = hashlib.sha256(f"{base} {own}".encode()).hexdigest()
        return cls(source, f"{own.partition(':')[0]}:{digest}", digest[:_DIGITS], revision)

    @property
    def identity(self) -> dict[str, Any]:
        """Checkpoint, digest and commit, for the info of a reset; empty without an adapter."""
        if not self.fingerprint:
            return {}
        return {"checkpoint": self.source, "weights": self.weights, "revision": self.revision}


class Adapters:
    """The adapters of one network."""

    def __init__(self) -> None:
        """Hold no adapter yet."""
        self._named: dict[str, Adapter] = {}
        self._places: dict[str, int] = {"": 0}  # by fingerprint: the place in the tensors of all adapters
        self._chosen: Any = None  # the places of the rows of the running pass, int64; None if no row has an adapter
        self._device: Any = None

    @property
    def ids(self) -> dict[str, str]:
        """The digest of each adapter with its base, by name."""
        return {name: adapter.weights for name, adapter in self._named.items()}

    def load(
        self,
        network: Any,
        sources: Mapping[str, str],
        find: Callable[[str], tuple[Adapter, Path]],
        adapt: Callable[[str, Path], None],
    ) -> None:
        """Read adapters, and have the layers of the network apply them from now on.

        Args:
            network: The torch module that they change.
            sources: The folder or hub id of each adapter, by name.
            find: Returns the adapter of a source, and its folder.
            adapt: Called with the fingerprint and the folder of each adapter that fits.

        Raises:
            ConfigError: One is missing, or does not fit.
        """
        import torch

        layers: dict[str, dict[int, tuple[Any, Any]]] = {}  # A and B by layer and place
        for name, source in sources.items():
            try:
                adapter, folder = find(source)
                place = self._places.setdefault(adapter.fingerprint, len(self._places))
                for layer, pair in read_adapter(folder, network).items():
                    layers.setdefault(layer, {})[place] = pair
                adapt(adapter.fingerprint, folder)
            except ConfigError as error:
                raise ConfigError(f"adapter {name!r}: {error}") from error
            self._named[name] = adapter
        modules = dict(network.named_modules())
        for layer, pairs in layers.items():
            weight = modules[layer].weight
            (outputs, *inputs), rank = weight.shape, max(len(down) for down, _ in pairs.values())
            downs = torch.zeros(len(self._places), rank, *inputs, dtype=weight.dtype, device=weight.device)
            ups = torch.zeros(len(self._places), outputs, rank, dtype=weight.dtype, device=weight.device)
            for place, (down, up) in pairs.items():
                downs[place, : len(down)], ups[place, :, : len(down)] = down, up
            modules[layer].register_forward_hook(partial(self._add, downs, ups))
            self._device = weight.device

    def named(self, name: object) -> Adapter:
        """Return the adapter of that name; for None, none.

        Raises:
            UnknownCheckpoint: There is no such adapter.
        """
        if name is None:
            return Adapter()
        if not isinstance(name, str) or name not in self._named:
            raise UnknownCheckpoint(
                f"{ADAPTER}: got {name!r}, want one of {sorted(self._named)}, or none, for the base"
            )
        return self._named[name]

    def example(self, number: int) -> str:
        """Return the fingerprint of an adapter for an example row, so that some of them have different ones."""
        return list(self._places)[(number + 1) % len(self._places)]

    def require(self, fingerprint: str) -> str:
        """Return the fingerprint; raise `UnknownSession` if a session came here whose adapter is not loaded here."""
        if fingerprint not in self._places:
            raise UnknownSession(f"its adapter {fingerprint} is not loaded here; reset the session")
        return fingerprint

    def stated(self, fingerprint: str) -> dict[str, Any]:
        """Return what an act says about the weights that computed it, if these are not the base's alone."""
        return {POLICY: {"version": 0, "fingerprint": fingerprint}} if fingerprint else {}

    @contextmanager
    def rows(self, fingerprints: Iterable[str]) -> Iterator[None]:
        """Have a pass of the network within this apply an adapter to each row.

        Args:
            fingerprints: The adapter of each row. In the first dimension, the inputs of linear layers have as many
                entries for each row, usually one, and one row after the other.
        """
        before = self._chosen
        self._chosen = self._tensor([self._places[one] for one in fingerprints])
        try:
            yield
        finally:
            self._chosen = before

    def _tensor(self, places: Sequence[int]) -> Any:
        if not any(places):
            return None
        import torch

        return torch.tensor(places, device=self._device)

    def _add(self, downs: Any, ups: Any, module: Any, inputs: tuple[Any, ...], output: Any) -> Any:
        """Return the output of a layer, with N entries, with the change of each row's adapter added."""
        chosen, [x] = self._chosen, inputs
        if chosen is None:
            return output
        if len(x) % len(chosen):
            raise PolicyFailed(f"adapters: a layer got {len(x)} entries for {len(chosen)} rows, want as many for each")
        if downs.ndim == 3:
            entries = x.reshape(len(chosen), -1, x.shape[-1])
            change = (entries @ downs[chosen].mT) @ ups[chosen].mT
        else:
            change = _convolved(module, x, downs, ups, chosen.repeat_interleave(len(x) // len(chosen)))
        return output + change.view(output.shape).to(output.dtype)


def _convolved(module: Any, x: Any, downs: Any, ups: Any, chosen: Any) -> Any:
    """Return ups (n, out, r) after convolutions downs (n, r, in, h, w) of x (N, in, H, W), those chosen for each entry.

    The entries are groups of one convolution, whose other settings are those of the module.
    """
    from torch.nn.functional import conv2d

    weight, entries = downs[chosen].flatten(0, 1), x.flatten(0, 1)[None]
    seen = conv2d(entries, weight, None, module.stride, module.padding, module.dilation, groups=len(x))
    return ups[chosen] @ seen.view(len(x), downs.shape[1], -1)


def require_base_alone(adapters: Mapping[str, str]) -> None:
    """Raise `NotTrainable` if adapters were trained on the base, which a learner would replace."""
    if adapters:
        raise NotTrainable(
            f"adapters {sorted(adapters)}: they belong to the weights of their checkpoint, which a learner's would "
            f"replace; train on a deployment without adapters"
        )
