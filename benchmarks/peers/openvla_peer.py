"""OpenVLA's REST server: FastAPI and uvicorn, `POST /act`, arrays as `json_numpy` writes them.

OpenVLA is not on PyPI. This is the server of its `vla-scripts/deploy.py` around a policy that does nothing, and the
client of its documentation: `requests.post(url, json=...).json()` with `json_numpy` patched in, a connection for each
call. OpenVLA's own request has one image; here it has the benchmark's two, and the joints, as in the fine-tuned forks,
so that every server gets the same observation.
"""

from __future__ import annotations

import json
import sys
from typing import Any, TextIO

import json_numpy
import peer

json_numpy.patch()

import numpy as np  # noqa: E402 - deploy.py patches json before it imports the rest
import requests  # noqa: E402
import uvicorn  # noqa: E402
from fastapi import FastAPI  # noqa: E402
from fastapi.responses import JSONResponse  # noqa: E402


def predict_action(payload: dict[str, Any]) -> JSONResponse:
    """Answer `POST /act`; FastAPI runs it in its thread pool, like OpenVLA's."""
    double_encoded = "encoded" in payload
    if double_encoded:
        payload = json.loads(payload["encoded"])
    for name in ("image", "wrist_image"):
        if not isinstance(payload[name], np.ndarray):
            raise TypeError(f"{name}: got {type(payload[name]).__name__}, want an array; is json_numpy patched in?")
    action = np.zeros(7, np.float32)
    return JSONResponse(json_numpy.dumps(action)) if double_encoded else JSONResponse(action)


def serve(host: str, port: int) -> None:
    """Run the server until the process ends."""
    app = FastAPI()
    app.post("/act", response_model=None)(predict_action)
    uvicorn.run(app, host=host, port=port)


def drive(host: str, port: int, path: str, _mode: str, out: TextIO) -> None:
    """Drive the server with the client of OpenVLA's documentation."""
    arrays = peer.observation(path)
    obs = {
        "image": arrays["camera_0"],
        "wrist_image": arrays["camera_1"],
        "state": np.append(arrays["joints"], np.float32(arrays["gripper"])),
        "instruction": "measure",
    }

    def call(obs: dict[str, Any]) -> None:
        action = requests.post(f"http://{host}:{port}/act", json=obs).json()  # noqa: S113 - as its users write it
        if not isinstance(action, np.ndarray):
            raise TypeError(f"got {action!r}, want an action")

    peer.obey(sys.stdin, out, lambda calls: peer.timed(lambda: obs, call, calls), {})


if __name__ == "__main__":
    peer.run(serve, drive)
