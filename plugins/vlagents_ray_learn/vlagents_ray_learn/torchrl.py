"""Policies of TorchRL on this server, and served policies as modules of TorchRL.

This module needs the extra "torchrl". A program that starts TorchRL's `ProcessInferenceServer` with
an `MPTransport` uses this server after two more lines:

    from vlagents_ray_learn.torchrl import PolicyServer as ProcessInferenceServer
    from vlagents_ray_learn.torchrl import ServerAddress as MPTransport

`ServedPolicy` is the module that TorchRL's collectors call; docs/evaluation/torchrl.md has an
example.

The keys of tensordicts are defined in `torchrl.data.vla`: the image is the camera "front", and the
state is `state["state"]` of an observation.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from typing_extensions import Self

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import BEHAVIOUR, POLICY, WANT, Act, Obs, TrainableAgent
from vlagents_ray.policies.base.model_inputs import camera_images, state_vector
from vlagents_ray.policies.outcomes import attempt, compute_valid
from vlagents_ray.registry import named_class, require
from vlagents_ray.serve.ports import free_port
from vlagents_ray.weights.trainable import named_values, set_values
from vlagents_ray_learn.columns import REPLAY
from vlagents_ray_learn.optional import optional

torch: Any = require("torch")
nn: Any = optional("tensordict.nn", "torchrl")
vla: Any = optional("torchrl.data.vla", "torchrl")
IMAGE, STATE, TEXT = vla.IMAGE_KEY, vla.STATE_KEY, vla.INSTRUCTION_KEY
_CAMERA = "front"
_STATE_NAME = "state"
_TOKENS = "tokens"
_LEARNED = ("logprob", REPLAY)  # values of an answer that a learner needs


class ServedPolicy(nn.TensorDictModuleBase):  # type: ignore[misc]
    """A policy on a server as a module of TorchRL.

    It reads images (*B, 3, H, W) uint8, a state (*B, D) float32 and instructions. Under the key
    "vla_action", it adds "chunk" (*B, H, D) float32, or "tokens" (*B, H, D) int64 and "log_probs"
    in nats, or all three. Tokens are drawn at random if TorchRL's exploration type is RANDOM.

    Each row is a session. Its episode begins where "is_init" is true (TorchRL's `InitTracker`) and
    where the instruction changes. Each copy of this module, which may be in another process, has
    its own sessions.
    """

    def __init__(self, url: str, **options: Any) -> None:
        """Set the server. The first call connects to it.

        Args:
            url: The URL of the server.
            options: Further arguments of `RemoteAgent`.
        """
        super().__init__()
        self.in_keys = [IMAGE, STATE, TEXT]
        self.out_keys = [vla.ACTION_CHUNK_KEY, "policy_version"]
        self._url = url
        self._options = {"priority": "simulation", **options}
        self._sessions: list[RemoteAgent] = []

    def forward(self, batch: Any) -> Any:
        """Add the policy's answers to a tensordict of observations, and return it.

        Raises:
            VLAgentsError: As for `RemoteAgent`.
        """
        rows = batch.reshape(-1)
        obs = [_observation(row) for row in rows]
        text = rows.get(TEXT)
        instructions = [text] * len(obs) if isinstance(text, str) else text.tolist()
        self._open_sessions(len(obs))
        self._begin_episodes(obs, instructions, rows.get("is_init", None))

        if nn.probabilistic.interaction_type() == nn.InteractionType.RANDOM:
            want = [name for name in _LEARNED if name in (self._contract.behaviour or ())]
            obs = [Obs(row.cameras, state=row.state, info={WANT: want}) for row in obs]
        sessions = self._sessions[: len(obs)]
        answers = _without_errors(sessions[0].act_batch(obs, sessions))

        for key, values in self._outputs(answers).items():
            shape = (*batch.batch_size, *values[0].shape)
            batch.set(key, torch.from_numpy(np.stack(values)).reshape(shape))
        return batch

    def _open_sessions(self, number: int) -> None:
        """Connect at the first call, and open sessions until `number` sessions are open."""
        if not self._sessions:
            agent = RemoteAgent(self._url, **self._options)
            self._sessions = [agent]
            self._instructions: dict[int, str] = {}  # row -> instruction of its current episode
            self._contract = agent.contract or Contract()
            self._seeds = np.random.default_rng()
        self._sessions += self._sessions[0].sessions(number - len(self._sessions))

    def _begin_episodes(
        self, obs: Sequence[Obs], instructions: Sequence[str], is_first: Any
    ) -> None:
        """Reset the sessions of the rows whose episode begins.

        Args:
            obs: The observation of each row.
            instructions: The instruction of each row.
            is_first: Whether each row is the first of an episode; None if this is unknown.
        """
        rows = []
        for i, instruction in enumerate(instructions):
            changed = self._instructions.get(i) != instruction
            if changed or (is_first is not None and is_first[i]):
                rows.append(i)
        if not rows:
            return
        seeds = self._seeds.integers(2**31, size=len(rows)).tolist()
        results = self._sessions[0].reset_batch(
            [obs[i] for i in rows],
            [instructions[i] for i in rows],
            [self._sessions[i] for i in rows],
            seeds=seeds,
        )
        _without_errors(results)
        for i in rows:
            self._instructions[i] = instructions[i]

    def _outputs(self, answers: Sequence[Act]) -> dict[Any, list[np.ndarray]]:
        """Return the values of all rows under TorchRL's keys."""
        versions = [np.array(answer.info[POLICY]["version"], np.int64) for answer in answers]
        outputs: dict[Any, list[np.ndarray]] = {"policy_version": versions}
        if self._contract.action.space != _TOKENS:
            outputs[vla.ACTION_CHUNK_KEY] = [answer.rows() for answer in answers]

        behaviours = [answer.info.get(BEHAVIOUR, {}) for answer in answers]
        if all(_TOKENS in behaviour.get(REPLAY, {}) for behaviour in behaviours):
            tokens = [np.array(behaviour[REPLAY][_TOKENS], np.int64) for behaviour in behaviours]
            logprobs = [np.array(behaviour["logprob"], np.float32) for behaviour in behaviours]
            outputs[vla.ACTION_TOKENS_KEY] = tokens
            outputs[vla.VLA_ACTION_KEY, "log_probs"] = logprobs
        return outputs

    def close(self) -> None:
        """End the sessions. A later call opens new sessions."""
        while self._sessions:
            self._sessions.pop().close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_sessions": []}


class TorchRLPolicy(TrainableAgent):
    """A VLA policy of TorchRL (`VLAWrapperBase`).

    It returns chunks, or tokens if it has a head of tokens and no `action_tokenizer`. The session's
    generator draws the tokens if a learner requests values. Otherwise, the most likely tokens are
    chosen.
    """

    trainable: ClassVar[str | None] = "policy"

    def __init__(self, factory: str) -> None:
        """Set the function that makes the policy.

        Args:
            factory: "module:function", or a file with the function, which cloudpickle has written.
                Such a file is trusted: it can run any code.
        """
        self._factory = factory
        self.policy: Any = None

    @property
    def contract(self) -> Contract | None:
        policy = self.policy
        if policy is None:
            return None
        has_tokens = policy.action_head == "tokens"
        space = _TOKENS if has_tokens and policy.action_tokenizer is None else None
        action = ActionSpec(policy.action_dim, space)
        return Contract(
            action=action, chunk=policy.chunk_size, behaviour=_LEARNED if has_tokens else None
        )

    def initialize(self) -> None:
        from ray import cloudpickle

        file = Path(self._factory)
        make: Any
        if file.is_file():
            make = cloudpickle.loads(file.read_bytes())
        else:
            make = named_class(self._factory)
        self.policy = make().eval()

    def parameters(self) -> dict[str, Any]:
        # Lazy layers get their sizes from the first batch. Before the first batch, there are no
        # values to push or to compare.
        has_lazy = any(map(torch.nn.parameter.is_lazy, self.policy.parameters()))
        return {} if has_lazy else named_values(self.policy)

    def load_parameters(self, values: Mapping[str, Any]) -> None:
        set_values(self.policy, values)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self._instruction = instruction or ""
        self._draws = np.random.default_rng(int(kwargs.get("seed") or 0) % 2**64)
        return {}

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Any]) -> list[Act | Exception]:
        rows = []
        for session_obs, session in zip(obs, sessions, strict=True):
            rows.append(attempt(_row, session_obs, session))
        return compute_valid(rows, self._compute_batch)

    def _compute_batch(self, rows: list[tuple[Any, np.random.Generator | None]]) -> Iterable[Act]:
        """Compute the answers of one batch.

        Args:
            rows: For each session, the input, and the generator that draws its tokens; None selects
                the most likely tokens.
        """
        policy = self.policy
        device = next(policy.parameters()).device
        batch = torch.stack([row for row, _ in rows]).contiguous().to(device)
        with torch.no_grad():
            if policy.action_head == "continuous":
                chunks = policy(batch)[vla.ACTION_CHUNK_KEY].float().cpu().numpy()
                return [Act(chunk) for chunk in chunks]

            distribution = policy.get_dist(batch)
            logits = getattr(distribution, "base_dist", distribution).logits  # (B, H, D, tokens)
            # The index of the largest logit after Gumbel noise is a draw from the softmax.
            shape = logits[0].shape
            noise = []
            for _, generator in rows:
                noise.append(np.zeros(shape) if generator is None else generator.gumbel(size=shape))
            noise_on_device = torch.from_numpy(np.stack(noise)).to(device, logits.dtype)
            tokens = (logits + noise_on_device).argmax(-1)
            # The log-probabilities, (B,), or (B, H, D) with `log_probs_mode="token"`.
            logprobs = distribution.log_prob(tokens)
            actions = tokens
            if policy.action_tokenizer is not None:
                actions = policy.action_tokenizer.decode(tokens)

        acts = []
        for action, action_tokens, logprob in zip(
            _on_host(actions.float()), _on_host(tokens), _on_host(logprobs.float()), strict=True
        ):
            behaviour = {"logprob": logprob, REPLAY: {_TOKENS: action_tokens}}
            acts.append(Act(action, info={BEHAVIOUR: behaviour}))
        return acts


class ServerAddress:
    """The address of a `PolicyServer` that starts later. It replaces TorchRL's `MPTransport`."""

    def __init__(self, **_torchrl_options: Any) -> None:
        self.port = free_port()

    def client(self) -> ServedPolicy:
        """Return a client. Its first call waits for the server."""
        return ServedPolicy(f"http://127.0.0.1:{self.port}")

    def close(self) -> None:
        """Do nothing, since the server closes its port."""


class PolicyServer:
    """A server of a `VLAWrapperBase`. It replaces TorchRL's `ProcessInferenceServer`.

    The server starts its own Ray. Of TorchRL's arguments, the following have an effect:
    `server_config.max_batch_size` limits the batch size, and Ray reserves a GPU for a
    `policy_device` "cuda". The waiting time for batches is the default of deployment files.
    """

    def __init__(
        self,
        *,
        policy_factory: Any,
        transport: Any,
        server_config: Any = None,
        policy_device: Any = "cpu",
        **_: Any,
    ) -> None:
        if not isinstance(transport, ServerAddress):
            raise ConfigError(
                f"transport: expected ServerAddress, got {type(transport).__name__}; import "
                "ServerAddress and PolicyServer from vlagents_ray_learn.torchrl"
            )
        self.transport = transport
        self._factory = policy_factory
        self._running = ExitStack()
        self._batch = {} if server_config is None else {"max_size": server_config.max_batch_size}
        self._resources = {"num_gpus": float(torch.device(policy_device).type == "cuda")}

    def start(self) -> Self:
        """Serve the policy, and wait until it is loaded."""
        # Ray is imported late, since environment processes import this module for the client, which
        # does not need Ray.
        from ray import cloudpickle

        from vlagents_ray.serve.launch.deployment_file import deployment
        from vlagents_ray.serve.launch.server import running_server
        from vlagents_ray_learn.publisher import Publisher

        with ExitStack() as stack:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="vlr-torchrl-"))
            file = Path(folder) / "factory"
            file.write_bytes(cloudpickle.dumps(self._factory))
            # The policy's process imports the factory's modules from the same folders.
            module_path = os.pathsep.join(filter(None, sys.path))
            args: dict[str, Any] = {
                "batch": self._batch,
                "resources": self._resources,
                "environment": {"env_vars": {"PYTHONPATH": module_path}},
            }
            plan = deployment(f"{__name__}:TorchRLPolicy", config={"factory": str(file)}, **args)
            stack.enter_context(running_server(plan, port=self.transport.port))
            self._publisher = Publisher(f"serve://{plan.applications[0].name}")
            self._running = stack.pop_all()
        return self

    def update_model_weights(self, weights: Any, **_: Any) -> dict[str, bool]:
        """Push new weights, which the policy uses from now on.

        Args:
            weights: A tensordict with all or some of the parameters.

        Raises:
            VLAgentsError: The errors of `Publisher.push`.
        """
        values = dict(weights.flatten_keys(".").items())
        # Before a learner's first batch, its lazy layers have no values.
        if all(value.numel() for value in values.values()):
            self._publisher.push(values, mode="keep", partial=True, allow_same=True)
        return {"accepted": True}

    def shutdown(self, timeout: float | None = None) -> None:
        """Stop the server and its Ray."""
        self._running.close()


def _without_errors(results: Sequence[Any]) -> Sequence[Any]:
    """Return the results of a batch, or raise the first error among them."""
    for result in results:
        if isinstance(result, Exception):
            raise result
    return results


def _on_host(values: Any) -> np.ndarray:
    """Return a tensor as an array."""
    array: np.ndarray = values.cpu().numpy()
    return array


def _observation(row: Any) -> Obs:
    """Return the observation in a row of a tensordict."""
    obs = Obs()
    image = row.get(IMAGE, None)  # (3, H, W)
    if image is not None:
        obs.cameras[_CAMERA] = _on_host(image.movedim(0, -1).contiguous())
    state = row.get(STATE, None)
    if state is not None:
        obs.state[_STATE_NAME] = _on_host(state.float())
    return obs


def _row(obs: Obs, session: TorchRLPolicy) -> tuple[Any, np.random.Generator | None]:
    """Return a session's input for the policy, and the generator that draws its tokens.

    Without values for a learner, the generator is None.
    """
    row = optional("tensordict", "torchrl").TensorDict({TEXT: session._instruction}, [])
    if IMAGE in session.policy.in_keys:
        image = camera_images(obs, {_CAMERA: _CAMERA})[_CAMERA]
        row[IMAGE] = torch.from_numpy(image.copy()).movedim(-1, 0)
    if STATE in session.policy.in_keys:
        row[STATE] = torch.from_numpy(state_vector(obs, [_STATE_NAME]))
    return row, session._draws if obs.info.get(WANT) else None
