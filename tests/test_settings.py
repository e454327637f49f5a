"""Values of settings without a model are compared with plain annotations and defaults."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vlagents_ray.errors import ConfigError
from vlagents_ray.settings import require_arguments


class Annotated:
    def __init__(
        self,
        gain: float = 0.5,
        steps: int = 3,
        name: str | None = None,
        fast: bool = False,
        where: Path = Path(),
        **more: Any,
    ) -> None: ...


class Bare:
    def __init__(self, gain=1, mode="auto", fast=False, rows=(1, 2), seed=None): ...  # type: ignore[no-untyped-def]


class Broken:
    def __init__(self, gain: NoSuchType = 1.0) -> None: ...  # type: ignore[name-defined]  # noqa: F821


@pytest.mark.parametrize(
    ("cls", "given"),
    [
        (
            Annotated,
            {
                "gain": 1,
                "steps": np.int64(2),
                "name": "x",
                "fast": True,
                "where": "/tmp",
                "other": object(),
            },
        ),
        (Annotated, {"gain": np.float32(1), "name": None}),
        (Bare, {"gain": 0.5, "mode": "slow", "fast": np.True_, "rows": [3], "seed": "any"}),
        (Broken, {"gain": 2}),
    ],
)
def test_what_fits_is_taken(cls: type, given: dict[str, Any]) -> None:
    require_arguments("policy P", cls, given)


@pytest.mark.parametrize(
    ("cls", "given", "said"),
    [
        (Annotated, {"gain": "high"}, "policy P: gain: expected float, got 'high'"),
        (Annotated, {"steps": 2.5}, "steps: expected int, got 2.5"),
        (Annotated, {"steps": True}, "steps: expected int, got True"),
        (Annotated, {"name": 7}, "name: expected str or None, got 7"),
        (Annotated, {"fast": "maybe"}, "fast: expected bool, got 'maybe'"),
        (Bare, {"gain": "high"}, "gain: expected float, got 'high'"),
        (Bare, {"mode": 3}, "mode: expected str, got 3"),
        (Bare, {"fast": 1}, "fast: expected bool, got 1"),
        (Broken, {"gain": "high"}, "gain: expected float, got 'high'"),
    ],
)
def test_what_does_not_is_told_before_it_is_used(
    cls: type, given: dict[str, Any], said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        require_arguments("policy P", cls, given)
