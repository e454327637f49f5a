"""Records the messages of SGLang, vLLM-Omni and FlashRT, for `upstream/test_engines.py` of the
dialects.

`python tests/support/engine_frames.py SGLANG_WHEEL VLLM_OMNI_WHEEL FLASHRT_SERVER` runs the message
modules of two wheels, and FlashRT's `examples/server.py`, on a CPU and without a network. A sum of
all inputs replaces the model, and placeholders replace the other modules that are imported. The
requests to SGLang and vLLM-Omni are packed with their own code. The script needs `msgspec`,
`fastapi` and `httpx`.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import importlib.abc
import importlib.util
import json
import sys
import zipfile
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

FOLDER = Path(__file__).parents[1] / "upstream/engines"
CAMERAS = ("base_0_rgb", "left_wrist_0_rgb")
ROWS, COLUMNS = 3, 4
OWN = (
    "sglang.multimodal_gen.configs.sample.action",
    "sglang.multimodal_gen.configs.sample.pi05",
    "sglang.multimodal_gen.runtime.entrypoints.action.protocol",
    "sglang.multimodal_gen.runtime.entrypoints.action.ws_utils",
    "sglang.multimodal_gen.runtime.entrypoints.action.openpi",
    "sglang.multimodal_gen.runtime.entrypoints.action.api",
    "vllm_omni.entrypoints.openpi.serving",
    "vllm_omni.entrypoints.openpi.connection",
)


def observed() -> tuple[dict[str, np.ndarray], np.ndarray, str]:
    """Return the images by camera, the state and the prompt of each recorded request."""
    rng = np.random.default_rng(7)
    images = {name: rng.integers(0, 256, (2, 2, 3), np.uint8) for name in CAMERAS}
    return images, rng.standard_normal(COLUMNS).astype(np.float32), "pick up the block"


def answered(images: dict[str, Any], state: Any, prompt: str) -> np.ndarray:
    """Return the actions for an observation, (ROWS, COLUMNS) float32, which depend on each part of
    it.
    """
    total = sum(
        (place + 1) * float(np.sum(images[name])) for place, name in enumerate(CAMERAS)
    ) + len(prompt)
    return (np.asarray(state) + np.arange(ROWS)[:, None] + total).astype(np.float32)


class _Kind(type):
    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return cls


class _Placeholder(metaclass=_Kind):
    def __init__(self, *_arguments: Any, **named: Any) -> None:
        self.extra_args = None
        vars(self).update(named)

    def __getattr__(self, name: str) -> Any:
        return lambda *_arguments, **_named: None

    def __iter__(self) -> Any:
        return iter(())


class _Wheels(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports the modules OWN from the wheels, and placeholders for the engines' other modules."""

    def __init__(self, files: dict[str, bytes]) -> None:
        self._files = files

    def find_spec(self, name: str, _path: Any, _target: Any = None) -> Any:
        if name.partition(".")[0] in ("sglang", "vllm", "vllm_omni", "omegaconf"):
            return importlib.util.spec_from_loader(name, self, is_package=name not in OWN)
        return None

    def exec_module(self, module: ModuleType) -> None:
        if module.__name__ in OWN:
            code = compile(
                self._files[module.__name__.replace(".", "/") + ".py"], module.__name__, "exec"
            )
            exec(code, vars(module))  # noqa: S102 - the wheel that the user named
        else:
            vars(module)["__getattr__"] = lambda name: getattr(_Placeholder, name)


class _Socket:
    """The server's end of a WebSocket whose client sends some requests and then disconnects."""

    def __init__(self, requests: list[bytes], args: Any) -> None:
        self.requests, self.sent = list(requests), []
        self.app = SimpleNamespace(state=SimpleNamespace(server_args=args))

    async def accept(self) -> None:
        pass

    async def close(self, **_reason: Any) -> None:
        pass

    async def send_bytes(self, data: bytes) -> None:
        self.sent.append(data)

    async def receive(self) -> dict[str, Any]:
        return (
            {"type": "websocket.receive", "bytes": self.requests.pop(0)}
            if self.requests
            else {"type": "websocket.disconnect"}
        )

    async def receive_bytes(self) -> bytes:
        from fastapi import WebSocketDisconnect

        if not self.requests:
            raise WebSocketDisconnect
        return self.requests.pop(0)


def sglang() -> dict[str, dict[str, Any]]:
    from sglang.multimodal_gen.configs.sample.pi05 import Pi05SamplingParams

    entrypoints = "sglang.multimodal_gen.runtime.entrypoints.action"
    api, openpi, protocol = (
        importlib.import_module(f"{entrypoints}.{name}") for name in ("api", "openpi", "protocol")
    )

    async def forward(request: Any) -> Any:
        if request.prompt == "fail":
            return SimpleNamespace(error="a secret of the upstream", output=None)
        actions = answered(request.images, request.state, request.prompt)
        return SimpleNamespace(
            error=None, output=[{"actions": actions, "timings": {"prefix_ms": 1.5}}]
        )

    protocol.prepare_request = lambda _args, params: params
    protocol.async_scheduler_client = SimpleNamespace(forward=forward)
    protocol._resolve_action_sampling_params_cls = lambda _args: Pi05SamplingParams
    Pi05SamplingParams._adjust = lambda _self, _args: None
    api.orjson_response = json.dumps
    config = SimpleNamespace(
        image_keys=CAMERAS,
        image_size=(224, 224),
        state_dim=COLUMNS,
        action_horizon=ROWS,
        output_action_dim=COLUMNS,
        action_dim=COLUMNS,
        default_num_inference_steps=10,
        policy_family="pi05",
        materialize_dtype="bf16",
        enable_autocast=False,
        enable_global_prefix_cache=False,
        prompt_token_buckets=(48,),
        prefix_cuda_graph_max_entries=1,
        action_cuda_graph_max_entries=1,
        prefix_parallel_strategy="none",
        action_parallel_strategy="none",
        parallel_layout_version=1,
        action_metadata=lambda _args: None,
        prefix_cuda_graph_available=lambda: False,
        action_cuda_graph_available=lambda: False,
    )
    parallel = dict.fromkeys(
        ("num_gpus", "tp_size", "sp_degree", "ulysses_degree", "ring_degree"), 1
    )
    args = SimpleNamespace(
        pipeline_config=config,
        served_model_name="pi05",
        model_path="pi05",
        kv_gather_degree=1,
        **parallel,
    )
    images, state, prompt = observed()
    dotted = {f"observation.images.{name}": image for name, image in images.items()}
    flat = {**dotted, "observation.state": state, "prompt": prompt}
    named = {"images": images, "state": state, "prompt": prompt}
    body = {"input": {"observation": named}, "runtime": {"response_format": "raw"}}

    async def talk(request: dict[str, Any]) -> tuple[list[bytes], list[bytes]]:
        socket = _Socket([protocol.pack_msgpack(request)], args)
        requests = list(socket.requests)
        try:
            await openpi.openpi_policy_ws(socket)
        except RuntimeError as error:
            print("its code raised, as recorded:", error)
        return requests, socket.sent

    async def post() -> tuple[bytes, bytes]:
        sent = protocol.pack_msgpack(body)

        async def content() -> bytes:
            return sent

        kind = {"content-type": "application/msgpack", "accept": "application/msgpack"}
        request = SimpleNamespace(
            headers=kind, body=content, app=SimpleNamespace(state=SimpleNamespace(server_args=args))
        )
        return sent, (await api.create_action_generation(request)).body

    async def about() -> bytes:
        request = SimpleNamespace(app=SimpleNamespace(state=SimpleNamespace(server_args=args)))
        return (await api.action_metadata_endpoint(request)).encode()

    sent, body_of_reply = asyncio.run(post())
    requests, replies = asyncio.run(talk(flat))
    failing, failed = asyncio.run(talk(flat | {"prompt": "fail"}))
    return {
        "sglang_websocket": {"requests": requests + failing, "replies": replies + failed[1:]},
        "sglang_http": {"requests": [sent], "replies": [asyncio.run(about()), body_of_reply]},
    }


def vllm_omni() -> dict[str, dict[str, Any]]:
    from vllm_omni.entrypoints.openpi.connection import RobotRealtimeConnection, _pack
    from vllm_omni.entrypoints.openpi.serving import PolicyServerConfig, ServingRealtimeRobotOpenPI

    class Engine:
        # vllm_omni/deploy/pi05.yaml, with this file's numbers of rows and columns
        model_config = SimpleNamespace(
            policy_server_config={
                "image_resolution": [224, 224],
                "n_external_cameras": 1,
                "needs_wrist_camera": True,
                "needs_session_id": False,
                "action_space": "joint_position",
                "action_horizon": ROWS,
                "action_dim": COLUMNS,
            }
        )

        async def generate(self, *, sampling_params_list: list[Any], **_named: Any) -> Any:
            seen = sampling_params_list[0].extra_args["robot_obs"]
            if seen["prompt"] == "fail":
                raise RuntimeError("a secret of the upstream")
            images = {name: seen[f"observation.images.{name}"] for name in CAMERAS}
            actions = answered(images, seen["state"], seen["prompt"])
            yield SimpleNamespace(multimodal_output={"actions": actions})

    sys.modules["vllm_omni.entrypoints.openpi.serving"].OmegaConf = SimpleNamespace(
        is_config=lambda _value: False
    )
    serving = ServingRealtimeRobotOpenPI.__new__(ServingRealtimeRobotOpenPI)
    serving.engine_client = Engine()
    serving.policy_server_config = PolicyServerConfig.from_model_config(Engine.model_config)
    serving._next_request_id = lambda session: session
    images, state, prompt = observed()
    dotted = {f"observation.images.{name}": image for name, image in images.items()}
    good = {**dotted, "state": state, "prompt": prompt, "endpoint": "infer", "session_id": "0" * 32}
    requests = [_pack({"endpoint": "reset"}), _pack(good), _pack(good | {"prompt": "fail"})]
    socket = _Socket(requests, None)
    asyncio.run(RobotRealtimeConnection(socket, serving).handle_connection())
    if len(socket.sent) != 1 + len(requests):
        raise RuntimeError(
            f"vllm-omni answered {len(socket.sent)} times, want the metadata and {len(requests)} "
            "answers"
        )
    return {"vllm_omni_websocket": {"requests": requests, "replies": socket.sent}}


def flashrt(server: Path) -> dict[str, dict[str, Any]]:
    from fastapi.testclient import TestClient

    def predict(images: list[np.ndarray], prompt: str) -> np.ndarray:
        if prompt == "fail":
            raise ValueError("a secret of the upstream")
        return answered(dict(zip(CAMERAS, images, strict=True)), np.zeros(COLUMNS), prompt)

    model = SimpleNamespace(framework="torch", prompt=None, predict=predict)
    sys.modules["flash_rt"] = SimpleNamespace(
        __version__="0.1.0", load_model=lambda **_settings: model
    )
    sys.argv = [str(server), "--checkpoint", "none"]
    module = ModuleType("flashrt_server")
    sys.modules[module.__name__], module.__file__ = module, str(server)
    code = compile(server.read_bytes(), str(server), "exec")
    exec(code, vars(module))  # noqa: S102 - the file that the user named
    client = TestClient(module.app)
    images, _, prompt = observed()
    texts = [base64.b64encode(image.tobytes()).decode() for image in images.values()]
    requests = [
        json.dumps({"images": texts, "prompt": text, "image_shape": [2, 2, 3]}).encode()
        for text in (prompt, "fail")
    ]
    kind = {"Content-Type": "application/json"}
    replies = [client.post("/predict", content=one, headers=kind).content for one in requests]
    return {
        "flashrt_http": {"requests": requests, "replies": [client.get("/health").content, *replies]}
    }


def main(sglang_wheel: str, vllm_omni_wheel: str, flashrt_server: str) -> None:
    files = {}
    for wheel in (sglang_wheel, vllm_omni_wheel):
        with zipfile.ZipFile(wheel) as archive:
            files |= {
                name: archive.read(name)
                for name in archive.namelist()
                if name[:-3].replace("/", ".") in OWN
            }
    sys.meta_path.insert(0, _Wheels(files))
    sources = {
        name: "code of " + "-".join(Path(wheel).name.split("-")[:2])
        for name, wheel in (("sglang", sglang_wheel), ("vllm", vllm_omni_wheel))
    }
    sources["flashrt"] = (
        "code of flashrt, examples/server.py, sha256 "
        f"{hashlib.sha256(Path(flashrt_server).read_bytes()).hexdigest()}"
    )
    for name, frames in (sglang() | vllm_omni() | flashrt(Path(flashrt_server))).items():
        texts = {
            key: [base64.b64encode(one).decode() for one in values]
            for key, values in frames.items()
        }
        document = {"source": sources[name.partition("_")[0]], **texts}
        (FOLDER / f"{name}.json").write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
