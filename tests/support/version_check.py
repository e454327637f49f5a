"""Serve, act, evaluate and collect rollouts once, with an environment's versions of Python and Ray.

`python tests/support/version_check.py FOLDER` runs in an environment with the packages of a server,
and prints one line of JSON. FOLDER contains `model.onnx`; the results are written there.
`versions.py` creates the environments.
"""

from __future__ import annotations

import importlib.util
import json
import platform
import sys
from pathlib import Path
from typing import Any

import numpy as np
import ray

import vlagents_ray
from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.evaluate import EvalConfig, evaluate
from vlagents_ray.serve.launch.deployment_file import Deployment
from vlagents_ray.serve.launch.server import running_server

OUTSIDE: tuple[TransportName, ...] = ("http", "websocket", "shm")
INSIDE: tuple[TransportName, ...] = ("handle", "plasma")
TABLETOP_DIM = 4  # number of values in an action of `tabletop`
EPISODES = 2
STEPS = 20


def deployment(model: Path) -> Deployment:
    """Return a deployment of the policies `noop` and `onnx` on one server."""
    onnx = {"checkpoint": str(model), "state": ["joints"]}
    apps = {
        "noop": {"policy": "noop", "config": {"action_dim": TABLETOP_DIM}},
        "onnx": {"policy": "onnx", "config": onnx},
    }
    applications = [
        {
            "name": name,
            "route_prefix": f"/{name}",
            "import_path": "vlagents_ray.serve.app:build",
            "args": args,
        }
        for name, args in apps.items()
    ]
    return Deployment.model_validate({"applications": applications})


def observation() -> Obs:
    state = {"joints": np.arange(4, dtype=np.float32)}
    return Obs({"front": np.zeros((64, 64, 3), np.uint8)}, state=state)


def act(url: str, transport: TransportName) -> list[float]:
    """Return the action after a reset and one observation."""
    with RemoteAgent(url, transport=transport) as agent:
        agent.reset(observation(), "lift")
        action = agent.act(observation()).action
        assert agent.transport == transport, agent.transport
    return [float(number) for number in action.ravel()]


@ray.remote(num_cpus=0)
def act_in_task(url: str, transport: TransportName) -> list[float]:
    """Call `act` in a worker on the node of the replica."""
    return act(url, transport)


def rollouts(url: str) -> int:
    """Return the number of steps of two episodes that a learner collects; 0 if the packages of
    rollouts are missing.
    """
    if importlib.util.find_spec("pyarrow") is None:
        return 0
    from vlagents_ray_learn import RolloutPlan, Rollouts

    plan = RolloutPlan(
        "tabletop/lift", url, workers=1, images=False, env_options={"max_steps": STEPS}
    )
    with Rollouts(plan) as collected:
        return int(collected.collect(EPISODES).num_rows)


def evaluation(url: str, out: Path) -> int:
    """Return the number of episodes with a result in an evaluation with one worker."""
    config = {
        "policies": [{"name": "noop", "url": url}],
        "suites": [
            {"envs": ["tabletop/lift"], "episodes": EPISODES, "env_options": {"max_steps": STEPS}}
        ],
        "workers": 1,
        "video": "none",
        "out": str(out),
    }
    summary = evaluate(EvalConfig.model_validate(config))
    return summary.total.episodes


def main(folder: Path) -> dict[str, Any]:
    """Run all parts, and return their results."""
    actions: dict[str, dict[str, list[float]]] = {}
    with running_server(deployment(folder / "model.onnx"), num_cpus=4) as server:
        for name, url in server.apps.items():
            actions[name] = {transport: act(url, transport) for transport in OUTSIDE}
            actions[name] |= {
                transport: ray.get(act_in_task.remote(f"serve://{name}", transport))
                for transport in INSIDE
            }
        return {
            "python": platform.python_version(),
            "ray": ray.__version__,
            "package": str(Path(vlagents_ray.__file__).parent),
            "actions": actions,
            "evaluated": evaluation(server.apps["noop"], folder / "results"),
            "collected": rollouts(server.apps["noop"]),
        }


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]))))
