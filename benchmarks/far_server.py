"""Serves the policy of `benchmarks.far_robot` until its standard input ends: `python -m benchmarks.far_server PORT`."""

from __future__ import annotations

import json
import sys

from vlagents_ray.bench.peers.peer import die_with_parent, own_stdout
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray.serve.ports import EVERYWHERE

POLICY = "benchmarks.far_robot:FarPolicy"


def main() -> None:
    """Run the process; it writes a line when the server is ready."""
    die_with_parent()
    out = own_stdout()
    with running_server(deployment(POLICY), host=EVERYWHERE, port=int(sys.argv[1]), insecure=True):
        print(json.dumps("ready"), file=out, flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
