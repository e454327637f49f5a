"""HIL-SERL with the policy on a server: LeRobot's learner trains, and vlagents_ray's control loop
is its actor, in place of `python -m lerobot.rl.actor`.

`python -m lerobot_policy_vlagents.hilserl CONFIG FOLDER` writes the first checkpoint for the
server.
"""

from __future__ import annotations

import contextlib
import json
import logging
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol

import grpc
import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.transport import services_pb2, services_pb2_grpc
from lerobot.transport.utils import (
    bytes_to_state_dict,
    grpc_channel_options,
    python_object_to_bytes,
    receive_bytes_in_chunks,
    send_bytes_in_chunks,
    transitions_to_bytes,
)
from lerobot.utils.constants import OBS_STATE

from vlagents_ray import Obs
from vlagents_ray.datasets.episode import Label, camera_keys, state_vector
from vlagents_ray.errors import ConfigError, Overloaded, PolicyUnavailable
from vlagents_ray.interface import copied

# The policy's modules by the learner's names.
_PARTS = {"policy": "actor", "discrete_critic": "discrete_critic"}
_SEND_S = 60.0  # time limit for the transitions of an episode, s
logger = logging.getLogger(__name__)


class Weights(Protocol):
    """The methods of `vlagents_ray_learn.Publisher` that are used here."""

    def push(self, named: dict[str, torch.Tensor], *, partial: bool, allow_same: bool) -> int:
        """Push weights to the served policy, and return their version."""


class Actor:
    """The recorder of a control loop whose episodes go to LeRobot's HIL-SERL learner.

        with Actor("train.json", Publisher("http://gpu-box:8000")) as actor:
            options = LoopOptions(reset_options={"weights": "follow"})
            run_loop(robot, player, hz=10, seconds=20, recorder=actor, options=options)

    The learner's parameters are pushed to the server when they arrive; the next episode uses them.
    An episode is sent when it ends, with the names that `vlagents_ray.robot.record.Recorder` uses.
    The label "success" becomes a reward of 1 in the last transition. An episode without a label
    counts as truncated.
    """

    interventions = True  # whether frames of an operator are accepted

    def __init__(
        self, config: str | Path, weights: Weights, *, connect_timeout_s: float = 60.0
    ) -> None:
        """Connect to the learner.

        Args:
            config: The learner's JSON file, with its address and the policy's `input_features`.
            weights: The publisher to the served policy.
            connect_timeout_s: Time limit for a learner that is still loading, s.

        Raises:
            PolicyUnavailable: The learner was not ready in time.
        """
        policy = json.loads(Path(config).read_text())["policy"]
        at = {"learner_host": "127.0.0.1", "learner_port": 50051} | policy.get(
            "actor_learner_config", {}
        )
        learner = f"{at['learner_host']}:{at['learner_port']}"
        self._inputs = {name: tuple(one["shape"]) for name, one in policy["input_features"].items()}
        self.version: int | None = None  # version of the last pushed weights
        self._weights = weights
        self._label: Label | None = None
        # Observation, action, and whether the action is an operator's.
        self._frames: list[tuple[Obs, np.ndarray, bool]] = []
        self._steps = 0  # steps of all episodes
        # Error of the thread, which the next episode or `close` raises.
        self._error: Exception | None = None
        self._channel = grpc.insecure_channel(learner, grpc_channel_options())
        self._stub = services_pb2_grpc.LearnerServiceStub(self._channel)
        try:
            self._stub.Ready(services_pb2.Empty(), wait_for_ready=True, timeout=connect_timeout_s)
        except grpc.RpcError as error:
            self._channel.close()
            raise PolicyUnavailable(
                f"HIL-SERL: no learner at {learner} within {connect_timeout_s:g} s "
                f"({error.code().name}); start it: python -m lerobot.rl.learner"
            ) from error
        self._closed = threading.Event()
        self._parameters = self._stub.StreamParameters(services_pb2.Empty())
        self._thread = threading.Thread(
            target=self._receive, name="hilserl-parameters", daemon=True
        )
        self._thread.start()

    @contextlib.contextmanager
    def episode(self, instruction: str) -> Iterator[None]:
        """Make one episode of the frames that are added within the context. An earlier error of the
        thread is raised first.
        """
        self._raise()
        self._label, self._frames = None, []
        try:
            yield
        finally:
            if self._frames and self._label != "discard":
                self._send()

    def label(self, label: Label) -> None:
        """Label the running episode "success", "failure" or "discard"; the last label counts."""
        self._label = label

    def add(self, obs: Obs, action: np.ndarray, *, intervention: bool = False, **_: object) -> None:
        """Store a frame until the episode ends; the arguments are those of `Recorder.add`.

        Raises:
            ConfigError: The first observation does not have the features of the policy.
        """
        if not self._frames:
            _state(obs, self._inputs)
        self._frames.append((copied(obs), np.array(action, np.float32), intervention))

    def close(self) -> None:
        """End the connection, and raise the first error of the thread."""
        self._closed.set()
        self._parameters.cancel()
        self._thread.join()
        self._channel.close()
        self._raise()

    def __enter__(self) -> Actor:
        return self

    def __exit__(self, *exc: object) -> None:
        with contextlib.suppress(Exception) if exc[0] is not None else contextlib.nullcontext():
            self.close()

    def _raise(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def _receive(self) -> None:
        """Push all parameters of the learner's stream to the server."""
        try:
            receive_bytes_in_chunks(
                self._parameters, SimpleNamespace(put=self._push), self._closed, "parameters"
            )
            raise PolicyUnavailable("HIL-SERL: the learner has ended")
        except Exception as error:  # noqa: BLE001 - raised by the caller's next method
            if not self._closed.is_set():
                self._error = error

    def _push(self, data: bytes) -> None:
        modules = bytes_to_state_dict(data)  # torch loads only weights, and executes no code
        named = {
            f"{_PARTS[part]}.{name}": value
            for part, one in modules.items()
            for name, value in one.items()
        }
        try:
            self.version = self._weights.push(named, partial=True, allow_same=True)
        except Overloaded as error:
            logger.info("the learner's next parameters are pushed instead: %s", error)

    def _send(self) -> None:
        done = transitions(self._frames, self._label, self._inputs)
        led = sum(intervention for *_, intervention in self._frames)
        self._steps += len(done)
        report = {
            "Episodic reward": done[-1]["reward"],
            "Interaction step": self._steps,
            "Episode intervention": int(led > 0),
            "Intervention rate": led / len(done),
        }
        for method, message, data in (
            (self._stub.SendTransitions, services_pb2.Transition, transitions_to_bytes(done)),
            (
                self._stub.SendInteractions,
                services_pb2.InteractionMessage,
                python_object_to_bytes(report),
            ),
        ):
            try:
                method(send_bytes_in_chunks(data, message), timeout=_SEND_S)
            except grpc.RpcError as error:
                raise PolicyUnavailable(
                    f"HIL-SERL: the learner did not accept the episode ({error.code().name}); is "
                    f"it "
                    "running?"
                ) from error


def transitions(
    frames: Sequence[tuple[Obs, np.ndarray, bool]],
    label: Label | None,
    inputs: Mapping[str, tuple[int, ...]],
) -> list[dict[str, Any]]:
    """Return an episode of N frames as N transitions of LeRobot; in the last transition, the next
    state equals the state.

    Args:
        frames: Observation, action (D,) float32, and whether an operator moved the robot.
        label: "success" is a reward of 1; None truncates the episode.
        inputs: The shapes of the policy's features.

    Raises:
        ConfigError: An observation has not these features.
    """
    states, last = [_state(obs, inputs) for obs, *_ in frames], len(frames) - 1
    return [
        {
            "state": states[number],
            "action": torch.from_numpy(action)[None],
            "reward": float(number == last and label == "success"),
            "next_state": states[min(number + 1, last)],
            "done": number == last and label is not None,
            "truncated": number == last and label is None,
            "complementary_info": {
                "discrete_penalty": torch.zeros(1),
                "is_intervention": intervention,
            },
        }
        for number, (_, action, intervention) in enumerate(frames)
    ]


def _state(obs: Obs, inputs: Mapping[str, tuple[int, ...]]) -> dict[str, torch.Tensor]:
    """Return an observation with LeRobot's names: images (1, 3, H, W) in [0, 1], the state
    (1, D).
    """
    values, _ = state_vector(obs.state, None if obs.gripper is None else np.array(obs.gripper))
    seen = {
        key: np.moveaxis(obs.cameras[name], -1, 0) for name, key in camera_keys(obs.cameras).items()
    }
    seen[OBS_STATE] = values
    if (got := {name: value.shape for name, value in seen.items() if name in inputs}) != inputs:
        raise ConfigError(
            f"input_features: expected {dict(inputs)}, got {got} from the robot; train the policy "
            f"with the robot's features"
        )
    found = {
        name: torch.from_numpy(np.ascontiguousarray(seen[name]))[None].float() for name in inputs
    }
    return {name: value if name == OBS_STATE else value / 255 for name, value in found.items()}


def write_checkpoint(config: Path, folder: Path) -> None:
    """Write the policy of a learner's configuration with random weights, as the first checkpoint of
    the server.

    Args:
        config: The learner's JSON file (`--config_path`), whose `policy` has the features.
        folder: The folder of the checkpoint, which is created.
    """
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(json.loads(config.read_text())["policy"]))
    settings: Any = PreTrainedConfig.from_pretrained(folder)
    get_policy_class(settings.type)(settings).save_pretrained(folder)
    # LeRobot 0.4 does not normalise in HIL-SERL, neither in the learner nor in the actor.
    if settings.type == "sac":
        settings.normalization_mapping = dict.fromkeys(
            settings.normalization_mapping, NormalizationMode.IDENTITY
        )
    for pipeline in make_pre_post_processors(settings, dataset_stats=settings.dataset_stats):
        pipeline.save_pretrained(folder)


if __name__ == "__main__":
    write_checkpoint(*map(Path, sys.argv[1:3]))
