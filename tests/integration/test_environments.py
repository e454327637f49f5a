"""Policies with conflicting packages in one deployment file on one cluster."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray
import yaml
from eval_fakes import LINE, wait_for
from in_process_evaluation import flat_config
from shared_ray import shared_server
from virtual_environments import ended, layered

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.evaluate import evaluate
from vlagents_ray.serve.launch.deployment_file import read_deployment
from vlagents_ray.serve.launch.server import Server
from vlagents_ray.serve.python_env.create import make_environment

pytestmark = pytest.mark.integration

AGENT = "python_env_agents:Telling"
# settings of the application "installed"
INSTALLED = {"uv": ["six==1.16.0"], "env_vars": {"VARIABLE": "set"}}
# versions of numpy and six
VERSIONS = {"old": ("1.26.4", "1.15.0"), "new": (np.__version__, "1.16.0")}


@dataclass(frozen=True, slots=True)
class Served:
    """A cluster with four applications, whose names are the names of their environments.

    "old" and "new" run in replicas, "apart" runs in a child process without Ray, and Ray installs
    the packages of "installed".
    """

    server: Server
    notes: dict[str, Path]  # files to which each policy writes its resets

    def said(self, app: str) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.notes[app].read_text().splitlines()]


@pytest.fixture(scope="module")
def served(shared_ray: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    home = tmp_path_factory.mktemp("environments")
    requirements = home / "apart.txt"
    requirements.write_text("six==1.15.0\nnumpy==1.26.4\n")
    environments = {
        "old": {"python": str(layered(home / "old", "numpy==1.26.4", "six==1.15.0"))},
        "new": {
            "python": str(layered(home / "new", "six==1.16.0")),
            "env_vars": {"VARIABLE": "set"},
        },
        "apart": {
            "python": str(make_environment(requirements, home / "apart", light=True)),
            "env_vars": {"VARIABLE": "set"},
        },
        "installed": {},
    }
    notes = {name: home / f"{name}.jsonl" for name in environments}
    file = home / "deployment.yaml"
    applications = [
        {
            "name": name,
            "route_prefix": f"/{name}",
            "import_path": "vlagents_ray.serve.app:build",
            "args": {
                "policy": AGENT,
                "config": {"needs": "six", "notes": str(notes[name])},
                "environment": environment,
            },
            **({"runtime_env": INSTALLED} if name == "installed" else {}),
        }
        for name, environment in environments.items()
    ]
    file.write_text(yaml.safe_dump({"applications": applications}))
    with shared_server(read_deployment(str(file))) as server:
        yield Served(server, notes)


def observation(value: float = 0.0, **info: Any) -> Obs:
    state = {"position": np.full(1, 0.5, np.float32)}
    return Obs(
        {"front": np.full((64, 64, 3), 7, np.uint8)}, state=state, info={"value": value, **info}
    )


@ray.remote(num_cpus=0)
class EnvActor:
    """An environment on the policy's node, in the driver's Python environment."""

    def drive(self, app: str, transport: TransportName) -> dict[str, Any]:
        with RemoteAgent(f"serve://{app}", transport=transport) as agent:
            agent.reset(observation(), "a task")
            agent.act(observation())
            return agent.act(observation()).info | {"transport": agent.transport}


def require_versions(app: str, told: dict[str, Any]) -> None:
    numpy, six = VERSIONS["old" if app in ("old", "apart") else "new"]
    assert (told["numpy"], told["six"]) == (numpy, six)
    assert told["ray"] == (None if app == "apart" else ray.__version__)
    assert Path(told["prefix"]).name == ("virtualenv" if app == "installed" else app)
    assert told["variable"] == (None if app == "old" else "set")
    assert told["gpus"] == ""  # no replica has requested a GPU


@pytest.mark.parametrize("app", ["old", "new", "apart", "installed"])
def test_each_policy_answers_with_its_own_versions_over_http(served: Served, app: str) -> None:
    with RemoteAgent(served.server.apps[app], transport="http") as agent:
        require_versions(app, agent.reset(observation(), "a task"))
        act = agent.act(observation())
        require_versions(app, act.info)
        assert act.action.tolist() == [-0.5]


@pytest.mark.parametrize("app", ["old", "new", "apart"])
@pytest.mark.parametrize("transport", ["plasma", "handle"])
def test_an_env_on_the_node_with_another_numpy_drives_each(
    served: Served, app: str, transport: TransportName
) -> None:
    actor = EnvActor.remote()  # type: ignore[attr-defined]
    told = ray.get(actor.drive.remote(app, transport))
    require_versions(app, told)
    assert (told["transport"], told["acts"]) == (transport, 2)


@pytest.mark.parametrize("app", ["old", "apart"])
def test_an_evaluation_drives_a_policy_in_its_environment(
    served: Served, app: str, tmp_path: Path
) -> None:
    before = len(served.said(app)) if served.notes[app].exists() else 0
    config = flat_config(
        envs=[LINE],
        episodes=4,
        workers=2,
        out=tmp_path / "out",
        video="none",
        policy_url=served.server.apps[app],
    )
    summary = evaluate(config)
    assert (summary.state, summary.total.episodes) == ("complete", 4)
    said = served.said(app)[before:]
    assert len(said) == 4
    for told in said:
        require_versions(app, told)


def test_a_killed_child_is_replaced_with_its_replica_and_the_session_goes_on(
    served: Served,
) -> None:
    with RemoteAgent(served.server.apps["apart"], timeout_s=120) as agent:
        first = agent.reset(observation(), "a task")
        agent.act(observation())
        os.kill(first["pid"], signal.SIGKILL)
        told = agent.act(observation()).info
        assert (told["resumed"], told["instruction"]) == (True, "a task")
        assert (told["pid"] != first["pid"], told["parent"] != first["parent"]) == (True, True)


def test_a_killed_replica_takes_its_child_along(served: Served) -> None:
    with RemoteAgent(served.server.apps["apart"], timeout_s=120) as agent:
        first = agent.reset(observation(), "a task")
        os.kill(first["parent"], signal.SIGKILL)
        wait_for(lambda: ended(first["pid"]))
        assert agent.act(observation()).info["pid"] != first["pid"]
