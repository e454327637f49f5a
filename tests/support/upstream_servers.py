"""Servers of other systems, whose bytes come from the systems' own packers, not from codecs of this
package.

`python upstream_servers.py KIND PORT [KIND PORT …]` serves all of them. A kind is the name of a
protocol. GR00T has two more kinds: `gr00t sim`, with `Gr00tSimPolicyWrapper`, and `gr00t packed`,
with the newest servers' arrays. Their answers depend on each bit of the observation, so that an
action that equals `answer` was computed from exactly this observation. The formats follow
openpi_client.msgpack_numpy, gr00t/policy/server_client.py, json_numpy and vla_eval.protocol.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Iterator, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import msgpack
import numpy as np
import websockets.sync.server
import zmq

ROWS, COLUMNS = 4, 7
CLOSED, BROKEN, SLOW = "close the connection", "raise an error", "take long"  # instructions


def answer(theirs: Mapping[str, Any], step: int = 0) -> np.ndarray:
    """Return the actions for an observation, (4, 7) float64, which stay distinct in float32."""
    return np.random.default_rng([_digest(theirs), step]).standard_normal((ROWS, COLUMNS))


def _digest(value: Any) -> int:
    if isinstance(value, Mapping):
        return zlib.crc32(
            repr([(str(key), _digest(value[key])) for key in sorted(value, key=str)]).encode()
        )
    if isinstance(value, np.ndarray):
        return zlib.crc32(value.tobytes(), zlib.crc32(f"{value.dtype.str}{value.shape}".encode()))
    return zlib.crc32(repr(value).encode())


def obey(text: str) -> None:
    if text == SLOW:
        time.sleep(1.5)
    if text == BROKEN:
        raise ValueError("a secret of the upstream")


def pack_openpi(value: Any) -> bytes:
    def node(one: Any) -> Any:
        if isinstance(one, np.ndarray):
            return {
                b"__ndarray__": True,
                b"data": one.tobytes(),
                b"dtype": one.dtype.str,
                b"shape": one.shape,
            }
        return {b"__npgeneric__": True, b"data": one.item(), b"dtype": one.dtype.str}

    return msgpack.packb(value, default=node)


def unpack_openpi(data: bytes) -> Any:
    def node(one: dict) -> Any:
        if b"__ndarray__" in one:
            return np.ndarray(
                buffer=one[b"data"], dtype=np.dtype(one[b"dtype"]), shape=one[b"shape"]
            )
        return one

    return msgpack.unpackb(data, object_hook=node)


def openpi(connection: Any) -> None:
    connection.send(pack_openpi({"robot": "libero"}))
    for message in connection:
        observation = unpack_openpi(message)
        if observation.get("prompt") == CLOSED:
            connection.close()
            return
        try:
            for one in observation.get("batch", [observation]):
                obey(one.get("prompt"))
            if "batch" in observation:
                actions = np.stack([answer(one) for one in observation["batch"]])
            else:
                actions = answer(observation)
        except ValueError as error:
            connection.send(f"Traceback of {error}")
            connection.close(1011)
            return
        connection.send(pack_openpi({"actions": actions, "server_timing": {"infer_ms": 1.0}}))


def roboarena(connection: Any) -> None:
    connection.send(
        pack_openpi(
            {"n_external_cameras": 1, "needs_wrist_camera": True, "action_space": "joint_position"}
        )
    )
    step = 0
    for message in connection:
        request = unpack_openpi(message)
        if request.pop("endpoint") == "reset":
            step = 0
            connection.send("reset successful")
            continue
        request.pop("session_id")
        if request["prompt"] == BROKEN:
            connection.send("Traceback of a secret of the upstream")
            connection.close(1011)
            return
        connection.send(pack_openpi(answer(request, step)))
        step += 1


def vla_eval(connection: Any) -> None:
    def array(one: Any) -> Any:
        return {
            "__ndarray__": True,
            "data": one.tobytes(),
            "dtype": one.dtype.str,
            "shape": list(one.shape),
        }

    def node(one: dict) -> Any:
        if "__ndarray__" in one:
            return np.frombuffer(one["data"], one["dtype"]).reshape(one["shape"])
        return one

    def send(kind: str, payload: dict, seq: int) -> None:
        message = {"type": kind, "payload": payload, "seq": seq, "timestamp": time.time()}
        connection.send(msgpack.packb(message, default=array))

    step = -1
    for data in connection:
        message = msgpack.unpackb(data, object_hook=node)
        if message["type"] == "hello":
            send(
                "hello",
                {"harness_version": "0.8.0", "protocol_version": 1, "model_server": "Double"},
                message["seq"],
            )
        elif message["type"] == "episode_start":
            step = 0
        elif step < 0 or message["payload"].get("task_description") == BROKEN:
            send("error", {"error": "observation_failed"}, message["seq"])
        else:
            send("action", {"actions": answer(message["payload"], step)[0]}, message["seq"])
            step += 1


def gr00t(port: int, *variants: str) -> None:
    packed = "packed" in variants

    def array(one: Any) -> Any:
        if packed:
            return {
                b"nd": True,
                b"type": one.dtype.str,
                b"kind": b"",
                b"shape": one.shape,
                b"data": one.tobytes(),
            }
        file = io.BytesIO()
        np.save(file, one, allow_pickle=False)
        return {"__ndarray_class__": True, "as_npy": file.getvalue()}

    def node(one: dict) -> Any:
        if packed and b"nd" in one:
            return np.frombuffer(one[b"data"], one[b"type"]).reshape(one[b"shape"])
        if not packed and "__ndarray_class__" in one:
            return np.load(io.BytesIO(one["as_npy"]), allow_pickle=False)
        return one

    modalities = {
        "video": ([0], ["ego", "wrist"]),
        "state": ([0], ["arm"]),
        "action": (list(range(ROWS)), ["arm", "gripper"]),
        "language": ([0], ["annotation.human.task_description"]),
    }
    socket = zmq.Context().socket(zmq.REP)
    socket.bind(f"tcp://127.0.0.1:{port}")
    while True:
        request = msgpack.unpackb(socket.recv(), object_hook=node)
        try:
            if request["endpoint"] == "get_modality_config":
                reply: Any = {
                    name: {
                        "__ModalityConfig__" if packed else "__ModalityConfig_class__": True,
                        "as_json": {"delta_indices": steps, "modality_keys": keys},
                    }
                    for name, (steps, keys) in modalities.items()
                }
            elif request["endpoint"] == "reset":
                reply = {}
            else:
                observation = request["data"]["observation"]
                if "sim" in variants:
                    actions = gr00t_actions(gr00t_nested(observation))
                    reply = [{f"action.{name}": array for name, array in actions.items()}, {}]
                else:
                    reply = [gr00t_actions(observation), {}]
        except ValueError as error:
            reply = {"error": str(error)}
        socket.send(msgpack.packb(reply, default=array))


def gr00t_nested(observation: dict[str, Any]) -> dict[str, Any]:
    """Nest flat keys like `Gr00tSimPolicyWrapper` reads them."""
    key = "annotation.human.task_description"
    named = {
        kind: {name: observation[f"{kind}.{name}"] for name in names}
        for kind, names in {"video": ("ego", "wrist"), "state": ("arm",)}.items()
    }
    return named | {"language": {key: [[text] for text in observation[key]]}}


def gr00t_actions(observation: dict[str, Any]) -> dict[str, np.ndarray]:
    [(key, texts)] = observation["language"].items()
    size = len(texts)
    each = [
        {
            **{
                name: array[i]
                for kind in ("video", "state")
                for name, array in observation[kind].items()
            },
            key: texts[i],
        }
        for i in range(size)
    ]
    obey(texts[0][0])
    actions = np.stack([answer(one) for one in each]).astype(np.float32)
    return {"arm": actions[..., :6], "gripper": actions[..., 6:]}


class OpenVLA(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def do_POST(self) -> None:
        def node(one: dict) -> Any:
            if "__numpy__" in one:
                data = base64.b64decode(one["__numpy__"])
                return np.frombuffer(data, one["dtype"]).reshape(one["shape"])
            return one

        observation = json.loads(
            self.rfile.read(int(self.headers["Content-Length"])), object_hook=node
        )
        if observation.get("instruction") == BROKEN:
            body = json.dumps("error")
        else:
            action = answer(observation)[0]
            data = base64.b64encode(action.tobytes()).decode()
            body = json.dumps(
                {"__numpy__": data, "dtype": action.dtype.str, "shape": list(action.shape)}
            )
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body.encode())

    def log_message(self, *_arguments: object) -> None:
        pass


@contextlib.contextmanager
def upstream(kind: str, port: int) -> Iterator[subprocess.Popen[bytes]]:
    """Run a server of a kind in a separate process, which is killed at the end."""
    with upstreams({port: kind}) as process:
        yield process


@contextlib.contextmanager
def upstreams(kinds: Mapping[int, str]) -> Iterator[subprocess.Popen[bytes]]:
    """Run several servers in one process, which is killed at the end; yield their ports."""
    words = [word for port, kind in kinds.items() for word in (kind, str(port))]
    process = subprocess.Popen([sys.executable, __file__, *words])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def _main(kind: str, port: int) -> None:
    protocol, *variants = kind.split()
    if protocol == "gr00t":
        gr00t(port, *variants)
    elif protocol == "openvla":
        ThreadingHTTPServer(("127.0.0.1", port), OpenVLA).serve_forever()
    else:
        handlers = {
            "openpi": openpi,
            "openpi-batch": openpi,
            "roboarena": roboarena,
            "vla_eval": vla_eval,
        }
        options: dict[str, Any] = {"compression": None, "max_size": None}
        with websockets.sync.server.serve(
            handlers[protocol], "127.0.0.1", port, **options
        ) as server:
            server.serve_forever()


if __name__ == "__main__":
    for kind, port in zip(sys.argv[1::2], sys.argv[2::2], strict=True):
        threading.Thread(target=_main, args=(kind, int(port))).start()
