"""The policy of `benchmarks.far_robot` behind the endpoints of a replica, in one process without
Ray.

`python -m benchmarks.far_server PORT` writes a line when it is ready, and answers each line with
the numbers of current and of opened sessions. It ends when its standard input ends.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from dataclasses import asdict

import uvicorn

from benchmarks.far_robot import FarPolicy
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.ports import EVERYWHERE
from vlagents_ray.serve.python_env.child_start import die_with_parent, own_stdout


def main() -> None:
    """Run the process."""
    die_with_parent()
    out = own_stdout()
    policy = FarPolicy()
    engine = Engine(policy)
    stream = OwnPortServer(engine, DEFAULT_LIMITS, EVERYWHERE, None, NoKey.OPEN)
    stream.open()
    engine.start()
    metadata = {
        "policy": "far",
        "version": "0",
        "protocol": PROTOCOL_VERSION,
        "stream": asdict(stream.address),
        "contract": policy.contract.to_json(),
    }
    app = AccessMiddleware(build_http_app(engine, lambda: metadata, DEFAULT_LIMITS), None, "far")
    server = uvicorn.Server(
        uvicorn.Config(app, host=EVERYWHERE, port=int(sys.argv[1]), log_level="warning")
    )
    threading.Thread(target=server.run, daemon=True).start()
    # Clients that connect before uvicorn has started try again.
    print(json.dumps("ready"), file=out, flush=True)
    for _ in sys.stdin:
        print(json.dumps([len(engine.sessions), engine.sessions.opened]), file=out, flush=True)
    os._exit(0)  # the server ends even if clients are still connected


if __name__ == "__main__":
    main()
