"""TorchRL: its `InferenceServer` in a process, with TorchRL's fastest transport between processes,
`process_slot`.

Each client has a slot in shared memory. Clients can only be created in the process that started the
server, so the clients' process starts it.
"""

from __future__ import annotations

import functools

import peer
import torch
from tensordict import TensorDict
from torchrl.modules.inference_server import InferenceServer


class TorchrlPolicy(torch.nn.Module):
    """The policy as a module that adds an action to a batch."""

    def __init__(self, policy: peer.Policy) -> None:
        super().__init__()
        self._policy = policy

    def forward(self, batch: TensorDict) -> TensorDict:
        return batch.set("action", torch.from_numpy(self._policy(len(batch))))


def _observation(target: peer.Target) -> TensorDict:
    return TensorDict(
        {"state": torch.from_numpy(target.state)}
        | {n: torch.from_numpy(i) for n, i in target.cameras.items()}
    )


@functools.cache
def _server(target: peer.Target) -> InferenceServer:
    """Start the server of all clients."""
    return InferenceServer(
        policy_factory=functools.partial(TorchrlPolicy, target.policy),
        service_backend="process",
        transport="process_slot",
        request_spec=_observation(target),
        response_spec=TensorDict(
            {"action": torch.zeros(7), "policy_version": torch.zeros((), dtype=torch.long)}
        ),
        num_clients=target.clients,
        max_batch_size=target.policy.batch,
    ).start()


def connect(target: peer.Target) -> peer.Client:
    """Return a client of TorchRL."""
    # TorchRL's own `client` returns the same client each time.
    (client,) = _server(target).clients(1)
    obs = _observation(target)
    return peer.Client(lambda: obs, lambda obs: client(obs)["action"].numpy())


if __name__ == "__main__":
    peer.run(None, connect)
