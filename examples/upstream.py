"""Use a model in another system's server: `policy: upstream`.

In this example, the server is openpi's: `theirs` implements openpi's protocol in a few lines, and
replaces `scripts/serve_policy.py` in a checkout of openpi. The policy `upstream` connects to the
server, and an evaluation runs episodes with the policy. `python upstream.py` does both in this
process. With the real server at ws://gpu-box:9000,

    python upstream.py ws://gpu-box:9000  # runs the same episodes, if its keys are those below
    vlagents-ray serve deployments/upstream.yaml  # adds batches, sessions, keys and the live page

docs/policies/upstream.md has the other protocols (GR00T, OpenVLA, RoboArena, vla-eval, vlagents)
and their keys.
"""

import contextlib
import sys
import threading
import time

import msgpack
import numpy as np
from rich.console import Console
from websockets.sync.server import serve

from vlagents_ray.evaluate import EvalConfig, evaluate, print_summary
from vlagents_ray_dialects.upstream import Upstream

MAPPING = {  # our names -> the server's names
    "cameras": {"front": "observation/image"},
    "state": {"xyzrpy": "observation/state"},
    "instruction": "prompt",
}


@contextlib.contextmanager
def theirs():
    """Run a server with openpi's protocol. Its model moves the hand to the middle of the table."""

    def answer(connection):
        connection.send(msgpack.packb({"robot": "example"}))  # the server's metadata
        for message in connection:
            observation = msgpack.unpackb(message)
            # The pose, (6,), m and rad.
            pose = np.frombuffer(observation["observation/state"][b"data"], np.float32)
            # A chunk, (10, 4).
            actions = np.tile(np.append(-0.5 * pose[:3], 1).astype(np.float32), (10, 1))
            array = {
                b"__ndarray__": True,
                b"data": actions.tobytes(),
                b"dtype": "<f4",
                b"shape": actions.shape,
            }
            connection.send(msgpack.packb({"actions": array}))

    with serve(answer, "127.0.0.1", 0, max_size=None) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield "ws://{}:{}".format(*server.socket.getsockname())
        finally:
            server.shutdown()
            thread.join()


def main(url):
    """Evaluate the model in a server of openpi."""
    config = {
        "protocol": "openpi",
        "urls": [url],
        "mapping": MAPPING,
        "contract": {"action": {"dim": 4}, "chunk": 10},
    }
    suite = {"envs": ["tabletop/lift"], "episodes": 3}
    out = time.strftime("runs/upstream-%H%M%S")
    plan = EvalConfig(
        policies=[{"name": "theirs"}], suites=[suite], out=out, video="none", workers=0
    )
    print_summary(Console(), evaluate(plan, agent_factory=lambda: Upstream.from_config(config)))


if __name__ == "__main__":
    with contextlib.nullcontext(sys.argv[1]) if len(sys.argv) > 1 else theirs() as server:
        main(server)
