"""A pickle of unknown origin is never opened; this needs neither the authors' code nor what it imports."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import pytest

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.diffusion_policy import DiffusionPolicy


class Touch:
    """A pickle that makes a file when it is loaded."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self._path,)


def test_nothing_is_unpickled_unless_it_is_trusted(tmp_path: Path) -> None:
    checkpoint, trace = tmp_path / "latest.ckpt", tmp_path / "trace"
    checkpoint.write_bytes(pickle.dumps(Touch(trace)))
    with pytest.raises(ConfigError, match="runs whatever code its author put in; set trust_checkpoint: true"):
        DiffusionPolicy.from_config({"checkpoint": str(checkpoint)}).initialize()
    assert not trace.exists()
    pickle.loads(checkpoint.read_bytes())  # noqa: S301 - the danger, shown on our own file
    assert trace.exists()  # what would have happened
