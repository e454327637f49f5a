"""What tests of cluster/ and docs/cluster share."""

from __future__ import annotations

import json

from eval_fakes import wait_for

from benchmarks.hosts import RayCluster

STATUS = """
import json, ray
from ray import serve
ray.init(logging_level="ERROR")
print(json.dumps({name: [app.status, app.message] for name, app in serve.status().applications.items()}))
"""


def serve_runs(cluster: RayCluster) -> None:
    """Wait until all applications of a cluster run; `AssertionError` if one fails."""

    def runs() -> bool:
        states = json.loads(cluster.python(STATUS).splitlines()[-1])
        failed = {name: state for name, state in states.items() if state[0] in ("DEPLOY_FAILED", "UNHEALTHY")}
        assert not failed, failed
        return bool(states) and all(state == "RUNNING" for state, _ in states.values())

    wait_for(runs)
