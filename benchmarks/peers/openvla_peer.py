"""OpenVLA's REST server: FastAPI and uvicorn, `POST /act`, with arrays as `json_numpy` writes them.

OpenVLA is not on PyPI. This module has the server of OpenVLA's `vla-scripts/deploy.py` with a
policy that does nothing, and the client of OpenVLA's documentation: `requests.post(url,
json=...).json()` with a patched `json_numpy`, and a connection for each call. OpenVLA's own request
has one image. Here a request has the benchmark's two images and the joints, as in the fine-tuned
forks, so that every server receives the same observation.
"""

from __future__ import annotations

import json
from typing import Any

import json_numpy
import peer

json_numpy.patch()

import numpy as np  # noqa: E402 - deploy.py patches json before it imports the rest
import requests  # noqa: E402
import uvicorn  # noqa: E402
from fastapi import FastAPI  # noqa: E402
from fastapi.responses import JSONResponse  # noqa: E402


def predict_action(policy: peer.Policy, payload: dict[str, Any]) -> JSONResponse:
    """Answer `POST /act`; FastAPI runs this function in its thread pool, as in OpenVLA's server."""
    double_encoded = "encoded" in payload
    if double_encoded:
        payload = json.loads(payload["encoded"])
    for name in ("image", "wrist_image"):
        if not isinstance(payload[name], np.ndarray):
            raise TypeError(
                f"{name}: expected an array, got {type(payload[name]).__name__}; is json_numpy "
                "patched in?"
            )
    (action,) = policy()
    return JSONResponse(json_numpy.dumps(action)) if double_encoded else JSONResponse(action)


def serve(host: str, port: int, policy: peer.Policy) -> None:
    """Run the server until the process ends."""
    app = FastAPI()

    @app.post("/act", response_model=None)
    def act(payload: dict[str, Any]) -> JSONResponse:
        return predict_action(policy, payload)

    uvicorn.run(app, host=host, port=port)


def connect(target: peer.Target) -> peer.Client:
    """Return the client of OpenVLA's documentation."""
    obs = {
        "image": target.arrays["camera_0"],
        "wrist_image": target.arrays["camera_1"],
        "state": target.state,
        "instruction": "measure",
    }

    def act(obs: dict[str, Any]) -> np.ndarray:
        action = requests.post(f"http://{target.host}:{target.port}/act", json=obs).json()  # noqa: S113 - as in OpenVLA's documentation
        if not isinstance(action, np.ndarray):
            raise TypeError(f"expected an action, got {action!r}")
        return action

    return peer.Client(lambda: obs, act)


if __name__ == "__main__":
    peer.run(serve, connect)
