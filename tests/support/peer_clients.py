"""Run several clients of another system at the same time: `peer_clients.py CLIENT URL CLIENTS
CALLS`, with the Python of the peers' environment.

Each client sends observations that identify it, under two alternating instructions. The last line
of the output is JSON: for each client a list of [sent observation, received rows]. The script
imports nothing of this package.
"""

from __future__ import annotations

import asyncio
import json
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np


def observations(client: int, calls: int) -> list[dict[str, Any]]:
    """Return the observations of a client: a pixel, a number in the state, and an instruction that
    changes once.
    """
    tasks = [f"task {client + 100 * (call >= calls // 2)}" for call in range(calls)]
    # The value 255 makes the policy slow.
    pixels = [(client * 16 + call) % 255 for call in range(calls)]
    return [
        {"pixel": p, "number": float(client + 1), "task": t}
        for p, t in zip(pixels, tasks, strict=True)
    ]


def image(pixel: int) -> np.ndarray:
    return np.full((224, 224, 3), pixel, np.uint8)


def openpi(url: str, client: int, calls: int) -> list[Any]:
    """openpi-client as in its LIBERO example, with host and port, or with a whole URL."""
    from openpi_client import image_tools
    from openpi_client.action_chunk_broker import ActionChunkBroker
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    host, _, port = url.removeprefix("ws://").partition(":")
    policy = (
        WebsocketClientPolicy(host, int(port)) if port.isdigit() else WebsocketClientPolicy(url)
    )
    if not policy.get_server_metadata():
        raise RuntimeError("no metadata")
    said = []
    for one in observations(client, calls):
        element = {
            "observation/image": image_tools.resize_with_pad(image(one["pixel"]), 224, 224),
            "observation/wrist_image": image(0),
            "observation/state": np.array([one["number"], 0, 0, 0, 0, 0, 0.02, -0.02]),
            "prompt": one["task"],
        }
        answer = policy.infer(element)
        timing = [answer["policy_timing"]["infer_ms"], answer["server_timing"]["infer_ms"]]
        if not all(ms >= 0 for ms in timing):
            raise RuntimeError(f"timing: {answer}")
        said.append([one, answer["actions"].tolist()])
    # The broker slices every array of an answer, so the answer must contain no arrays except the
    # actions.
    if said:
        chunk = len(said[-1][1])
        broker = ActionChunkBroker(policy, chunk)
        rows = [broker.infer(element)["actions"].tolist() for _ in range(chunk)]
        if [row[4] for row in rows] != list(range(chunk)):
            raise RuntimeError(f"broker: {rows}")
    return said


def roboarena(url: str, client: int, calls: int) -> list[Any]:
    """RoboArena's client, which is openpi's with an `endpoint` in each request. It is not
    on PyPI.
    """
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    policy = WebsocketClientPolicy(url)
    config = policy.get_server_metadata()
    if config["action_space"] != "joint_position" or config["image_resolution"] != [224, 224]:
        raise RuntimeError(f"config: {config}")
    said = []
    for number, one in enumerate(observations(client, calls)):
        if number == calls // 2:
            policy._ws.send(policy._packer.pack({"endpoint": "reset"}))
            if policy._ws.recv() != "reset successful":
                raise RuntimeError("reset failed")
        joints = np.array([one["number"], 0, 0, 0, 0, 0, 0], np.float32)
        obs = {
            "observation/exterior_image_0_left": image(one["pixel"]),
            "observation/wrist_image_left": image(0),
            "observation/joint_position": joints,
            "observation/cartesian_position": np.zeros(6, np.float32),
            "observation/gripper_position": np.zeros(1, np.float32),
            "prompt": one["task"],
            "endpoint": "infer",
        }
        said.append([one, policy.infer(obs)["actions"].tolist()])
    return said


def openpi_error(url: str, client: int, calls: int) -> list[Any]:
    """Return the error that openpi-client raises for an observation that lacks a key."""
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    policy = WebsocketClientPolicy(url)
    try:
        policy.infer({"prompt": "task 1", "observation/image": image(1)})
    except RuntimeError as error:
        return [str(error)]
    return ["no error"]


def openpi_keyed(url: str, client: int, calls: int) -> Any:
    """Connect with the fragment of the URL as the API key, which this client sends itself. Return
    the answers, or the reason of a failure.
    """
    from openpi_client.websocket_client_policy import WebsocketClientPolicy
    from websockets.exceptions import InvalidStatus

    address, _, key = url.partition("#")
    element = {
        "observation/image": image(client),
        "observation/wrist_image": image(0),
        "observation/state": np.zeros(8),
        "prompt": "abc",
    }
    try:
        return (
            WebsocketClientPolicy(address, api_key=key or None).infer(element)["actions"].tolist()
        )
    except InvalidStatus as error:
        return error.response.status_code


def openvla(url: str, client: int, calls: int) -> list[Any]:
    """requests and json-numpy as in OpenVLA's documentation. Every second call encodes the document
    twice.
    """
    import json_numpy
    import requests

    said = []
    for number, one in enumerate(observations(client, calls)):
        payload = {
            "image": image(one["pixel"]),
            "instruction": one["task"],
            "unnorm_key": "bridge_orig",
        }
        if number % 2:
            answer = requests.post(
                f"{url}/act", json={"encoded": json_numpy.dumps(payload)}, timeout=60
            ).json()
            action = json_numpy.loads(answer)
        else:
            answer = requests.post(f"{url}/act", data=json_numpy.dumps(payload), timeout=60)
            answer.raise_for_status()
            action = json_numpy.loads(answer.text)
        said.append([one, [np.asarray(action).tolist()]])
    return said


def openvla_patched(url: str, client: int, calls: int) -> list[Any]:
    """The same client with json_numpy's patch of the json module, as in OpenVLA's own code."""
    import json_numpy
    import requests

    json_numpy.patch()
    action = requests.post(  # noqa: S113 - users of OpenVLA write it so
        f"{url}/act",
        json={"image": np.zeros((256, 256, 3), dtype=np.uint8), "instruction": "do something 7"},
    ).json()
    return [[{"pixel": 0, "number": 0.0, "task": "task 7"}, [action.tolist()]]]


def vla_eval(url: str, client: int, calls: int, codec: str = "png") -> list[Any]:
    """vla-eval's Connection, with two episodes."""
    from vla_eval.connection import Connection

    async def talk() -> list[Any]:
        said = []
        async with Connection(url) as connection:
            if connection.server_info["protocol_version"] != 1:
                raise RuntimeError(f"hello: {connection.server_info}")
            for number, one in enumerate(observations(client, calls)):
                if number in (0, calls // 2):
                    await connection.start_episode({"task": {"name": one["task"]}})
                obs = {
                    "images": {"front": image(one["pixel"])},
                    "task_description": one["task"],
                    "state": np.array([one["number"], 0.0]),
                }
                answer = await connection.act(obs)
                said.append([one, [answer["actions"].tolist()]])
            await connection.end_episode({"success": True})
        return said

    return asyncio.run(talk())


def vla_eval_run(url: str, client: int, calls: int, benchmark: str = "Pictures") -> list[Any]:
    """Run vla-eval including its orchestrator: `calls` episodes of a benchmark of
    `peer_benchmark`.
    """
    from vla_eval.orchestrator import Orchestrator

    with tempfile.TemporaryDirectory() as folder:
        config = {
            "server": {"url": url},
            "output_dir": folder,
            "benchmarks": [
                {
                    "benchmark": f"peer_benchmark:{benchmark}",
                    "episodes_per_task": calls,
                    "max_steps": 100,
                }
            ],
        }
        return asyncio.run(Orchestrator(config, no_save=True).run())


def robotwin_run(url: str, client: int, calls: int) -> list[Any]:
    """Run vla-eval's RoboTwin."""
    return vla_eval_run(url, client, calls, "RoboTwin")


def robodojo_run(url: str, client: int, calls: int) -> list[Any]:
    """Run vla-eval's RoboDojo."""
    return vla_eval_run(url, client, calls, "RoboDojo")


def main(name: str, url: str, clients: int, calls: int) -> None:
    with ThreadPoolExecutor(clients) as pool:
        futures = [pool.submit(globals()[name], url, client, calls) for client in range(clients)]
        print(json.dumps([future.result() for future in futures]))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
