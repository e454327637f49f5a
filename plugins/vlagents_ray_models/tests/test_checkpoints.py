"""Checkpoints of the families: requested with their commit, and unpickled only where that is
allowed.
"""

from __future__ import annotations

import pickle
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from empty_hub import empty_hub

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.checkpoint import used_checkpoints
from vlagents_ray.policies.base.checkpoint_files import weights_of
from vlagents_ray.registry import entries, named_class
from vlagents_ray_models.diffusion_policy import (
    DiffusionPolicy,
    DiffusionPolicyConfig,
    checkpoint_file,
)

COMMIT = "0123456789abcdef0123456789abcdef01234567"
NAMED = f"org/name@{COMMIT}"
POLICIES = entries("policies")
# Functions that need the family's packages, and are called before the search for the checkpoint.
CALLED_BEFORE = {
    "gr00t": ["vlagents_ray_models.gr00t._use_checkout"],
    "octo": ["vlagents_ray_models.octo.octo_model_class"],
    "openpi": [f"vlagents_ray_models.openpi.{name}" for name in ("use_source", "train_config")],
}


def families() -> list[Any]:
    params = []
    for name, entry in POLICIES.items():
        config = named_class(entry.target).Config
        if "checkpoint" in getattr(config, "model_fields", ()):
            marks = pytest.mark.torch if name == "vjepa2_ac" else ()
            params.append(pytest.param(name, marks=marks))
    return params


@pytest.mark.parametrize("family", families())
def test_a_family_asks_for_the_commit(family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    requested = empty_hub(monkeypatch)
    for function in CALLED_BEFORE.get(family, ()):
        monkeypatch.setattr(function, lambda *_args, **_options: None)
    cls = named_class(POLICIES[family].target)
    fields = cls.Config.model_fields
    settings: dict[str, Any] = {
        name: "any" for name, field in fields.items() if field.is_required()
    }
    settings["checkpoint"] = NAMED
    if "trust_checkpoint" in fields:
        settings["trust_checkpoint"] = True
    policy = cls.from_config(settings)
    with pytest.raises(ConfigError, match="nor available from the hub"):
        policy.initialize()
    assert requested == [("org/name", COMMIT)]


def test_a_repository_with_one_file_of_diffusion_policy_is_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    snapshot = tmp_path / "models--org--name" / "snapshots" / COMMIT
    (snapshot / "checkpoints").mkdir(parents=True)
    blob = tmp_path / "blob"
    blob.write_bytes(b"weights")
    (snapshot / "checkpoints" / "latest.ckpt").symlink_to(blob)  # as in the hub's cache
    (snapshot / "big.mp4").touch()
    hub = SimpleNamespace(snapshot_download=lambda *_args, **_options: str(snapshot))
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)

    config = DiffusionPolicyConfig(checkpoint=NAMED, trust_checkpoint=True)
    with used_checkpoints() as used:
        assert checkpoint_file(config) == snapshot / "checkpoints" / "latest.ckpt"
    assert used == [snapshot / "checkpoints" / "latest.ckpt"]
    weights = weights_of(used)
    assert weights is not None
    assert weights["revision"] == COMMIT

    branch = DiffusionPolicyConfig(checkpoint="org/name@main", trust_checkpoint=True)
    with pytest.raises(
        ConfigError,
        match=rf"expected the commit that you trust, as this is a pickle of the hub.*{NAMED}",
    ):
        checkpoint_file(branch)

    (snapshot / "other.ckpt").touch()
    with pytest.raises(
        ConfigError, match=r"expected one \.ckpt file.*\['checkpoints/latest.ckpt', 'other.ckpt'\]"
    ):
        checkpoint_file(config)


class Touch:
    """A pickle that creates a file when it is loaded."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self._path,)


def test_nothing_is_unpickled_unless_it_is_trusted(tmp_path: Path) -> None:
    checkpoint, trace = tmp_path / "latest.ckpt", tmp_path / "trace"
    checkpoint.write_bytes(pickle.dumps(Touch(trace)))
    with pytest.raises(
        ConfigError, match="runs whatever code its author put in; set trust_checkpoint: true"
    ):
        DiffusionPolicy.from_config({"checkpoint": str(checkpoint)}).initialize()
    assert not trace.exists()
    pickle.loads(checkpoint.read_bytes())  # noqa: S301 - the danger, shown on our own file
    assert trace.exists()
