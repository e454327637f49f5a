"""Whether pushed values fit the ones that a policy holds, and a digest of what it holds."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidWeights, UnchangedWeights
from vlagents_ray.weights.trainable import converted, dtype_name, is_array, portable

_SHOWN = 5  # faults in a message
_THREADS = 4  # that compute a fingerprint: hashing releases Python's lock
_KINDS = (("float", "bfloat"), ("int", "uint"), ("bool",), ("complex",))


def fitted(
    held: Mapping[str, Any], pushed: Mapping[str, Any], *, partial: bool = False, allow_same: bool = False
) -> dict[str, Any]:
    """Return the complete values of the new version, converted to the types and devices of those held.

    Args:
        held: The values that the policy has now, by name.
        pushed: The new values, by name: numpy or JAX arrays or torch tensors, on any device.
        partial: Whether names may be missing, whose held values stay, as in a push of adapters alone.
        allow_same: Whether all values may equal those held.

    Raises:
        InvalidWeights: A name is unknown or missing, or a value has another shape or kind of type, or is not finite.
        UnchangedWeights: All values equal those held, and `allow_same` is not set.
    """
    require_fit(held, pushed, partial=partial)
    new = {name: converted(value, held[name]) for name, value in pushed.items()}
    _refuse([f"{name!r}: got NaN or infinite values, want finite ones" for name in new if not _is_finite(new[name])])
    if not allow_same and all(_is_equal(value, held[name]) for name, value in new.items()):
        raise UnchangedWeights(
            f"weights: all {len(new)} values equal those that the policy holds; push what the optimizer changes, "
            f"or allow it with allow_same=True"
        )
    return {name: new.get(name, value) for name, value in held.items()}


def require_fit(held: Mapping[str, Any], pushed: Mapping[str, Any], *, partial: bool = False) -> None:
    """Raise `InvalidWeights` if a name is unknown or missing, or a value has another shape or kind of type.

    `pushed` are values, or their `vlagents_ray.weights.safetensors.ValueSpec`; with `partial`, names may be missing.
    """
    faults = [f"{name!r}: unknown, want one of the policy's {len(held)} names" for name in pushed if name not in held]
    if not partial:
        faults += [f"{name!r}: missing; push it, or set partial=True" for name in held if name not in pushed]
    elif not pushed:
        faults += ["no value: push at least one"]
    faults += [fault for name in pushed if name in held and (fault := _misfit(name, pushed[name], held[name]))]
    _refuse(faults)


def fingerprint(named: Mapping[str, Any]) -> str:
    """Return a digest of 32 hexadecimal characters over names, shapes, types and all bytes of values on any device.

    A sample would be faster, and the same for weights that differ elsewhere.
    """
    found = hashlib.blake2b(digest_size=16)
    names = sorted(named)
    with ThreadPoolExecutor(_THREADS, "fingerprint") as threads:
        for name, digest in zip(names, threads.map(_digest, (named[name] for name in names)), strict=True):
            found.update(f"{name} {dtype_name(named[name])} {tuple(named[name].shape)}\n".encode())
            found.update(digest)
    return found.hexdigest()


def _refuse(faults: list[str]) -> None:
    if faults:
        more = f"; and {len(faults) - _SHOWN} more" if len(faults) > _SHOWN else ""
        raise InvalidWeights(f"weights, of which nothing was changed: {'; '.join(faults[:_SHOWN])}{more}")


def _misfit(name: str, pushed: Any, held: Any) -> str | None:
    if not is_array(pushed):
        return f"{name!r}: got {type(pushed).__name__}, want an array"
    if tuple(pushed.shape) != tuple(held.shape):
        return f"{name!r}: got shape {tuple(pushed.shape)}, want {tuple(held.shape)}"
    if _kind(dtype_name(pushed)) != _kind(dtype_name(held)):
        return f"{name!r}: got {dtype_name(pushed)}, want {dtype_name(held)}"
    return None


def _kind(dtype: str) -> Any:
    """Return what is equal for types of one kind: precisions are converted, kinds are not."""
    return next((kind for kind in _KINDS if dtype.startswith(kind)), dtype)


def _is_finite(value: Any) -> bool:
    if not dtype_name(value).startswith(("float", "bfloat", "complex")) or 0 in value.shape:
        return True
    if isinstance(value, np.ndarray):
        with np.errstate(over="ignore", invalid="ignore"):
            # Minimum and maximum need no array of booleans, which would take a quarter of the value's memory.
            return bool(np.isfinite(value.min()) and np.isfinite(value.max()))
    torch = sys.modules.get("torch")
    library = torch if torch is not None and isinstance(value, torch.Tensor) else sys.modules["jax"].numpy
    return bool(library.isfinite(value).all())


def _is_equal(new: Any, held: Any) -> bool:
    return np.array_equal(new, held) if isinstance(new, np.ndarray) else bool((new == held).all())


def _digest(value: Any) -> bytes:
    data = np.ascontiguousarray(portable(value)).reshape(-1).view(np.uint8)
    return hashlib.blake2b(data, digest_size=16).digest()  # type: ignore[arg-type]
