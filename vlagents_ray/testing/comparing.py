"""The error of both test suites, and comparisons that report where two values differ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from vlagents_ray.envs.base import EvalEnv
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.interface import Act, Agent, Obs

_SCALARS = (bool, int, float, str, bytes)


class ContractViolation(VLAgentsError):
    """A policy or an environment does not implement its interface; the message names the place."""


def require_wireable(value: object, where: str) -> None:
    """Raise `ContractViolation` unless a message can carry `value`."""
    if value is None or type(value) in _SCALARS:
        return
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biuf":
            raise ContractViolation(f"{where}: got an array of {value.dtype}, want numbers or bools")
    elif isinstance(value, dict):
        for key, item in value.items():
            if not isinstance(key, str):
                raise ContractViolation(f"{where}: got the key {key!r}, want only str keys")
            require_wireable(item, f"{where}[{key!r}]")
    elif isinstance(value, list):
        for i, item in enumerate(value):
            require_wireable(item, f"{where}[{i}]")
    else:
        raise ContractViolation(
            f"{where}: got {type(value).__module__}.{type(value).__qualname__}, which a message cannot carry; "
            f"want None, bool, int, float, str, bytes, numpy arrays, lists and dicts of them"
        )


def difference(a: object, b: object, where: str, atol: float = 0.0) -> str | None:
    """Describe the first difference between two values.

    Returns:
        The description; None if the values are equal.
    """
    if a is b:
        return None
    a, b = _plain(a), _plain(b)
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return _array_difference(a, b, where, atol)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        if a.keys() != b.keys():
            return f"{where} has {sorted(a)} once and {sorted(b)} the other time"
        found_inside = (difference(a[key], b[key], f"{where}[{key!r}]", atol) for key in a)
        return next((found for found in found_inside if found), None)
    if isinstance(a, (list, tuple)) and isinstance(b, (list, tuple)):
        if len(a) != len(b):
            return f"{where} has {len(a)} items once and {len(b)} the other time"
        in_items = (difference(x, y, f"{where}[{i}]", atol) for i, (x, y) in enumerate(zip(a, b, strict=True)))
        return next((found for found in in_items if found), None)
    return None if type(a) is type(b) and a == b else f"{where} is {a!r} once and {b!r} the other time"


def _plain(value: object) -> object:
    """Convert tensors and images to arrays, and objects that have attributes but no equality to dictionaries."""
    if isinstance(value, Act):  # without its info, which may contain times
        return {"action": value.action, "done": value.done}
    if isinstance(value, Obs):
        return {name: getattr(value, name) for name in ("cameras", "gripper", "state", "info")}
    if is_dataclass(value) and not isinstance(value, type):
        return {part.name: getattr(value, part.name) for part in fields(value)}
    if hasattr(value, "__array__") and not isinstance(value, (np.ndarray, np.generic)):
        return np.asarray(value.float() if "bfloat16" in str(getattr(value, "dtype", "")) else value)  # type: ignore[attr-defined]
    if type(value).__eq__ is object.__eq__ and hasattr(value, "__dict__"):
        return vars(value)
    return value


def _array_difference(a: np.ndarray, b: np.ndarray, where: str, atol: float) -> str | None:
    if a.shape != b.shape or a.dtype != b.dtype:
        return f"{where} is {a.shape} {a.dtype} once and {b.shape} {b.dtype} the other time"
    if np.array_equal(a, b, equal_nan=a.dtype.kind == "f"):
        return None
    off = np.abs(a.astype(np.float64) - b.astype(np.float64))
    if off.max() <= atol:
        return None
    return f"{where} differs in {np.count_nonzero(off > atol)} of {a.size} numbers, by up to {off.max():.4g}"


def require_same(a: Any, b: Any, where: str, because: str, atol: float = 0.0) -> None:
    """Raise `ContractViolation` with the difference and the reason `because` unless two values are equal."""
    found = difference(a, b, where, atol)
    if found:
        raise ContractViolation(f"{found}; {because}")


def check_close(made: Agent | EvalEnv) -> None:
    """Close an agent or an environment twice, which must be safe."""
    for attempt in ("first", "second"):
        try:
            made.close()
        except Exception as error:
            raise ContractViolation(
                f"close: the {attempt} call raised {error!r}; it must be safe to call twice"
            ) from error
