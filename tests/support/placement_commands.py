"""Commands that tests of placement run on each host: a server with two applications, an evaluation,
and a robot.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from eval_fakes import Line, wait_for

from vlagents_ray import RemoteAgent
from vlagents_ray.interface import Obs

PORT = 8000
# The custom resource of which each replica of an application takes one.
RESOURCE = {"one": "of_one", "two": "of_two"}
REPLICAS = {"one": 1, "two": 2}


class Meeting(Line):
    """An environment whose first episode begins when `expected` workers have each begun one."""

    def __init__(self, folder: str, expected: int) -> None:
        super().__init__()
        self._folder, self._expected, self._met = Path(folder), expected, False

    def reset(
        self, *, seed: int, options: Mapping[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        if not self._met:
            self._met = True
            (self._folder / str(seed)).touch()
            wait_for(lambda: len(list(self._folder.iterdir())) >= self._expected)
        return super().reset(seed=seed, options=options)


def serve() -> None:
    """Serve both applications until standard input ends."""
    from vlagents_ray.serve.launch.deployment_file import deployment, together
    from vlagents_ray.serve.launch.server import running_server

    both = together(
        {
            app: deployment(
                "eval_fakes:ToZero", replicas=number, resources={"custom": {RESOURCE[app]: 1}}
            )
            for app, number in REPLICAS.items()
        }
    )
    with running_server(both, host="0.0.0.0", port=PORT, address="auto", insecure=True):  # noqa: S104 - other hosts connect
        print("ready", flush=True)
        sys.stdin.read()


def play(app: str, workers: str, transport: str, out: str) -> None:
    """Run an evaluation with a number of workers, and print the host and the transport of each."""
    import ray

    from vlagents_ray.evaluate import evaluate
    from vlagents_ray.evaluate.plan.config import EvalConfig
    from vlagents_ray.evaluate.results.reader import Results

    ray.init("auto", log_to_driver=False)
    # Workers of the previous evaluation that are still ending occupy the CPUs of their node, so new
    # workers would start elsewhere.
    wait_for(lambda: ray.available_resources().get("CPU") == ray.cluster_resources()["CPU"])
    met = Path(out, "met")
    met.mkdir(parents=True)
    config = EvalConfig.model_validate(
        {
            "policies": [{"url": f"serve://{app}", "transport": transport}],
            "suites": [
                {
                    "envs": ["placement_commands:Meeting"],
                    "env_options": {"folder": str(met), "expected": int(workers)},
                    "episodes": 2 * int(workers),
                }
            ],
            "workers": int(workers),
            "worker": {"cpus": 1},
            "video": "none",
            "retries": 0,
            "out": Path(out, "results"),
        }
    )
    summary = evaluate(config)
    found = Results.load(config.out)
    said = [(one.host, one.transport) for one in found.workers]
    print(json.dumps({"workers": sorted(said), "episodes": summary.total.episodes}))


def robot(url: str) -> None:
    """Act ten times over each transport that reaches another machine, and print the transports
    used.
    """
    obs = Obs(
        {"front": np.zeros((224, 224, 3), np.uint8)}, state={"position": np.ones(1, np.float32)}
    )
    used = []
    for transport in ("auto", "http"):
        with RemoteAgent(url, transport=transport) as agent:  # type: ignore[arg-type]
            agent.reset(obs, "a task", seed=0)
            for _ in range(10):
                agent.act(obs)
            used.append(agent.transport)
    print(json.dumps(used))


if __name__ == "__main__":
    {"serve": serve, "play": play, "robot": robot}[sys.argv[1]](*sys.argv[2:])
