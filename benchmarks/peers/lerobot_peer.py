"""LeRobot's asynchronous inference: its gRPC `PolicyServer`, and the calls of its `RobotClient`,
which needs a robot.

An act consists of the calls `SendObservations` and `GetActions`, as in LeRobot's control loop. The
server's `inference_latency` (33 ms by default) is 0, and no processors run before and after the
policy. The server has one queue with one place for all clients, so it serves one robot at a time.
"""

from __future__ import annotations

import functools
import itertools
import pickle
import time
from types import SimpleNamespace
from typing import Any

import grpc
import numpy as np
import peer
import torch

# A torchvision whose build does not fit torch lacks these operators.
_OPERATORS = torch.library.Library("torchvision", "FRAGMENT")
for _name in ("nms", "qnms"):
    _OPERATORS.define(f"{_name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")

from lerobot.async_inference import helpers  # noqa: E402

# Without this, LeRobot would create a folder in the working directory.
helpers.get_logger = functools.partial(helpers.get_logger, log_to_file=False)

from lerobot.async_inference import policy_server  # noqa: E402
from lerobot.async_inference.configs import PolicyServerConfig  # noqa: E402
from lerobot.datasets.utils import hw_to_dataset_features  # noqa: E402
from lerobot.transport import services_pb2, services_pb2_grpc  # noqa: E402
from lerobot.transport.utils import grpc_channel_options, send_bytes_in_chunks  # noqa: E402

NAME = "bench"


class LerobotPolicy:
    """The policy as one of LeRobot's, which returns chunks of one action."""

    policy = peer.Policy()

    @classmethod
    def from_pretrained(cls, _path: str) -> LerobotPolicy:
        return cls()

    def to(self, _device: str) -> None:
        """Do nothing: the policy stays on its device."""

    @property
    def config(self) -> Any:
        image = SimpleNamespace(shape=(3, 224, 224))
        return SimpleNamespace(
            image_features={f"observation.images.camera_{i}": image for i in range(2)}
        )

    def predict_action_chunk(self, _observation: dict[str, torch.Tensor]) -> torch.Tensor:
        return torch.from_numpy(self.policy()[None])


def serve(host: str, port: int, policy: peer.Policy) -> None:
    """Run LeRobot's server, with the policy registered."""
    LerobotPolicy.policy = policy
    policy_server.SUPPORTED_POLICIES.append(NAME)
    policy_server.get_policy_class = {NAME: LerobotPolicy}.__getitem__
    policy_server.make_pre_post_processors = lambda *_, **__: (
        lambda obs: obs,
        lambda action: action,
    )
    policy_server.serve(PolicyServerConfig(host=host, port=port, inference_latency=0.0))


def connect(target: peer.Target) -> peer.Client:
    """Connect as LeRobot's `RobotClient` does."""
    joints = {f"joint_{i}": float(value) for i, value in enumerate(target.state)}
    features = dict.fromkeys(joints, float) | {
        name: image.shape for name, image in target.cameras.items()
    }
    obs = {**joints, **target.cameras, "task": "measure"}
    stub = services_pb2_grpc.AsyncInferenceStub(
        grpc.insecure_channel(f"{target.host}:{target.port}", grpc_channel_options())
    )
    stub.Ready(services_pb2.Empty())
    wanted = helpers.RemotePolicyConfig(
        NAME, "", hw_to_dataset_features(features, "observation", use_video=False), 1
    )
    stub.SendPolicyInstructions(services_pb2.PolicySetup(data=pickle.dumps(wanted)))
    steps = itertools.count()

    def act(obs: dict[str, Any]) -> np.ndarray:
        timed = helpers.TimedObservation(
            timestamp=time.time(), timestep=next(steps), observation=obs, must_go=True
        )
        stub.SendObservations(
            send_bytes_in_chunks(pickle.dumps(timed), services_pb2.Observation, silent=True)
        )
        (action,) = pickle.loads(stub.GetActions(services_pb2.Empty()).data)  # noqa: S301 - LeRobot's protocol
        return action.get_action().numpy()

    return peer.Client(lambda: obs, act)


if __name__ == "__main__":
    peer.run(serve, connect)
