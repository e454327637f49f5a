"""Model families served from their deployment files, each in its own environment, all on one
cluster.

`make families` creates the environments. Each family's own code creates tiny random checkpoints.
Families whose code is on no package index also need their source (`OPENPI_SRC`, …) and their
environment (`make families FAMILIES=openpi`).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray
import yaml
from family_env import DESK, DeskActor, play
from in_process_evaluation import flat_config

from vlagents_ray.evaluate import evaluate
from vlagents_ray.serve.launch.deployment_file import read_deployment
from vlagents_ray.serve.launch.server import Server, running_server

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[2]
TESTS = "plugins.vlagents_ray_models.tests.families"
# prefix of the environments' folders, to which -NAME is added
ENVIRONMENTS = os.environ.get("VLAGENTS_RAY_ENVIRONMENTS") or sys.prefix


@dataclass(frozen=True, slots=True)
class Family:
    """A deployment file, and its changes for a tiny checkpoint."""

    file: str  # name of the file in deployments/
    environment: str
    tests: str  # the folder in the families' tests whose tiny.py makes the checkpoint
    kind: tuple[str, ...] = ()
    within: str = ""  # path of the checkpoint in the folder that tiny.py wrote
    config: dict[str, Any] = field(default_factory=dict)
    # In the values, {} stands for the folder that tiny.py wrote.
    env_vars: dict[str, str] = field(default_factory=dict)
    source: str | None = None  # the variable with the checkout of its source
    atol: float = 1e-4


_CEM = {
    "image_size": 32,
    "encoder_heads": 2,
    "predictor_heads": 2,
    "samples": 12,
    "topk": 4,
    "iterations": 3,
}
FAMILIES = {
    "lerobot": Family("lerobot", "lerobot", "lerobot", ("act",), config={"state": ["xyzrpy"]}),
    "smolvla": Family("lerobot", "lerobot", "lerobot", ("smolvla",), config={"state": ["xyzrpy"]}),
    "pi0": Family("pi0", "hf", "pi0"),
    "vjepa2_ac": Family("vjepa2_ac", "hf", "vjepa2_ac", config=_CEM, source="VJEPA2_SRC"),
    "openpi": Family(
        "pi05",
        "openpi",
        "openpi",
        ("pi05",),
        config={"config": f"{TESTS}.openpi.tiny:PI05", "batch_sizes": [1, 2], "steps": 4},
        env_vars={"OPENPI_DATA_HOME": "{}/cache", "PYTHONPATH": str(ROOT)},
        source="OPENPI_SRC",
    ),
    "openvla": Family("openvla", "openvla", "openvla", source="OPENVLA_SRC"),
    "openvla_oft": Family(
        "openvla_oft",
        "openvla",
        "openvla",
        ("oft",),
        config={"unnorm_key": "bridge_orig"},
        source="OPENVLA_OFT_SRC",
    ),
    "octo": Family("octo", "octo", "octo", config={"batch_sizes": [1, 2]}, source="OCTO_SRC"),
    "gr00t": Family(
        "isaac_gr00t",
        "gr00t",
        "gr00t",
        within="checkpoint",
        config={
            "embodiment": "new_embodiment",
            "cameras": {"ego_view": "front"},
            "state": ["xyzrpy"],
        },
        env_vars={"GR00T_SRC": "{}/src"},  # a version with a small backbone
        source="GR00T_SRC",
    ),
    "diffusion_policy": Family(
        "diffusion_policy",
        "diffusion_policy",
        "diffusion_policy",
        ("image",),
        within="checkpoints/latest.ckpt",
        source="DIFFUSION_POLICY_SRC",
    ),
}


def python_of(family: Family) -> Path:
    return Path(f"{ENVIRONMENTS}-{family.environment}") / "bin" / "python"


def present() -> dict[str, Family]:
    return {name: f for name, f in FAMILIES.items() if f.source is None or os.environ.get(f.source)}


def application(name: str, family: Family, home: Path) -> dict[str, Any]:
    """Return the file's only application, with a tiny checkpoint and with this test run's
    environment.
    """
    python = python_of(family)
    assert python.is_file(), f"{python} is missing: make families FAMILIES={family.environment}"
    script = ROOT.joinpath(*TESTS.split("."), family.tests, "tiny.py")
    subprocess.run(
        [python, script, home / name, *family.kind],
        check=True,
        stdout=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    [app] = yaml.safe_load((ROOT / "deployments" / f"{family.file}.yaml").read_text())[
        "applications"
    ]
    app["name"], app["route_prefix"] = name, f"/{name}"
    args = app["args"]
    args["environment"]["python"] = str(python)
    env_vars = {key: value.format(home / name) for key, value in family.env_vars.items()}
    if family.source is not None:
        env_vars.setdefault(family.source, os.environ[family.source])
    args["environment"]["env_vars"] = env_vars
    args["config"] |= {"checkpoint": str(home / name / family.within), **family.config}
    args.pop("dialects", None)
    args["resources"]["num_gpus"] = 0
    return app


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    home = tmp_path_factory.mktemp("families")
    file = home / "all.yaml"
    file.write_text(
        yaml.safe_dump({"applications": [application(n, f, home) for n, f in present().items()]})
    )
    with running_server(read_deployment(str(file)), num_cpus=4) as server:
        yield server


def each() -> list[Any]:
    marks = {
        name: [pytest.mark.source(f.source)] if f.source else [] for name, f in FAMILIES.items()
    }
    return [pytest.param(name, marks=marks[name]) for name in FAMILIES]


@pytest.mark.parametrize("name", each())
def test_it_acts_the_same_through_http_and_for_an_env_actor_on_its_node(
    server: Server, name: str
) -> None:
    transport, by_http = play(server.apps[name], "http", 3)
    assert transport == "http"
    actor = DeskActor.remote()  # type: ignore[attr-defined]
    transport, by_plasma = ray.get(actor.play.remote(f"serve://{name}", "plasma", 3))
    assert transport == "plasma"
    for one, other in zip(by_http, by_plasma, strict=True):
        assert np.isfinite(one).all()
        assert one.std() > 0
        np.testing.assert_allclose(one, other, atol=FAMILIES[name].atol)
    _, another = play(server.apps[name], "http", 4)
    assert not np.allclose(by_http[0], another[0], atol=1e-3)


def test_families_whose_packages_contradict_are_evaluated_side_by_side(
    server: Server, tmp_path: Path
) -> None:
    told = [versions(family) for family in present().values()]
    assert len({found.get("transformers") for found in told}) > 1
    if set(present()) & {"openvla", "octo"}:  # these families need a numpy older than 2
        assert {found["numpy"].partition(".")[0] for found in told} == {"1", "2"}
    for name in present():
        config = flat_config(
            envs=[DESK],
            episodes=2,
            workers=2,
            execute=1,
            out=tmp_path / name,
            video="none",
            policy_url=server.apps[name],
        )
        summary = evaluate(config)
        assert (summary.state, summary.total.episodes, summary.total.policy_errors) == (
            "complete",
            2,
            0,
        )


def versions(family: Family) -> dict[str, str]:
    installed = "{one.name: one.version for one in importlib.metadata.distributions()}"
    code = f"import importlib.metadata, json; print(json.dumps({installed}))"
    found = subprocess.run(
        [python_of(family), "-c", code], check=True, capture_output=True, text=True
    )
    return {
        name: version
        for name, version in json.loads(found.stdout).items()
        if name in ("numpy", "transformers")
    }
