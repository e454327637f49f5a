"""TorchRL's policies on this server, and served policies as modules of TorchRL; needs the extra
"torchrl".

A program that starts TorchRL's `ProcessInferenceServer` with an `MPTransport` uses this server
after one more line:

    from vlagents_ray_learn.torchrl import PolicyServer as ProcessInferenceServer, ServerAddress as
    MPTransport

Collectors are TorchRL's own: `ServedPolicy` is the module that they call
(docs/evaluation/torchrl.md has one).

Keys are those of `torchrl.data.vla`: of the image (camera "front"), the state (part "state") and
the instruction.
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
from vlagents_ray.interface import BEHAVIOUR, POLICY, WANT, Act, Agent, Obs
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
_STATE_PART = "state"
_TOKENS = "tokens"
_LEARNED = ("logprob", REPLAY)  # values of an action that a learner needs


class ServedPolicy(nn.TensorDictModuleBase):  # type: ignore[misc]
    """A policy on a server as a module of TorchRL.

    It reads images (*B, 3, H, W) uint8, a state (*B, D) float32 and instructions, and adds "chunk"
    (*B, H, D) float32, or "tokens" (*B, H, D) int64 and "log_probs" in nats, or all, below
    "vla_action". Tokens are drawn where TorchRL's exploration type is RANDOM. Each row is a
    session, whose episode begins where "is_init" is true (TorchRL's `InitTracker`) and where the
    instruction changes. Copies, also in other processes, have their own sessions.
    """

    def __init__(self, url: str, **options: Any) -> None:
        """Set the server, to which the first call connects; the arguments are those of
        `RemoteAgent`.
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
            obs = [Obs(sent.cameras, state=sent.state, info={WANT: want}) for sent in obs]
        answers = _without_errors(self._sessions[0].act_batch(obs, self._sessions[: len(obs)]))
        for key, values in self._outputs(answers).items():
            shape = (*batch.batch_size, *values[0].shape)
            batch.set(key, torch.from_numpy(np.stack(values)).reshape(shape))
        return batch

    def _open_sessions(self, number: int) -> None:
        """Connect at the first call, and open sessions until there are that many."""
        if not self._sessions:
            agent = RemoteAgent(self._url, **self._options)
            self._sessions = [agent]
            self._instructions: dict[int, str] = {}  # of the running episode, by row
            self._contract = agent.contract or Contract()
            self._seeds = np.random.default_rng()
        self._sessions += self._sessions[0].sessions(number - len(self._sessions))

    def _begin_episodes(
        self, obs: Sequence[Obs], instructions: Sequence[str], is_first: Any
    ) -> None:
        """Reset the sessions of the rows whose episode begins; `is_first` marks them, and may be
        None.
        """
        begun = []
        for i, instruction in enumerate(instructions):
            changed = self._instructions.get(i) != instruction
            if changed or (is_first is not None and is_first[i]):
                begun.append(i)
        if not begun:
            return
        seeds = self._seeds.integers(2**31, size=len(begun)).tolist()
        results = self._sessions[0].reset_batch(
            [obs[i] for i in begun],
            [instructions[i] for i in begun],
            [self._sessions[i] for i in begun],
            seeds=seeds,
        )
        _without_errors(results)
        self._instructions |= {i: instructions[i] for i in begun}

    def _outputs(self, answers: Sequence[Act]) -> dict[Any, list[np.ndarray]]:
        """Return the values of each row by TorchRL's keys."""
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
        """End the sessions; a later call begins others."""
        while self._sessions:
            self._sessions.pop().close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_sessions": []}


class TorchRLPolicy(Agent):
    """A VLA policy of TorchRL (`VLAWrapperBase`), which returns chunks, or tokens if it has no
    `action_tokenizer`.

    Tokens are drawn by the session's generator if a learner requests values; else they are the
    likeliest. `factory` makes the policy: "module:function", or a file with the function by
    cloudpickle, trusted, as it may run any code.
    """

    trainable: ClassVar[str | None] = "policy"

    def __init__(self, factory: str) -> None:
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
        make: Any = (
            cloudpickle.loads(file.read_bytes()) if file.is_file() else named_class(self._factory)
        )
        self.policy = make().eval()

    def parameters(self) -> dict[str, Any]:
        # Lazy layers get their sizes from the first batch; until then there is nothing to push or
        # to compare.
        lazy = any(map(torch.nn.parameter.is_lazy, self.policy.parameters()))
        return {} if lazy else named_values(self.policy)

    def load_parameters(self, values: Mapping[str, Any]) -> None:
        set_values(self.policy, values)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self._instruction = instruction or ""
        self._draws = np.random.default_rng(int(kwargs.get("seed") or 0) % 2**64)
        return {}

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Any]) -> list[Act | Exception]:
        rows = [
            attempt(_row, received, session)
            for received, session in zip(obs, sessions, strict=True)
        ]
        return compute_valid(rows, self._acts)

    def _acts(self, rows: list[tuple[Any, np.random.Generator | None]]) -> Iterable[Act]:
        """Compute one batch; each row has an input, and the generator of its draw, or None for
        the likeliest tokens.
        """
        policy = self.policy
        device = next(policy.parameters()).device
        batch = torch.stack([row for row, _ in rows]).contiguous().to(device)
        with torch.no_grad():
            if policy.action_head == "continuous":
                return [
                    Act(chunk)
                    for chunk in policy(batch)[vla.ACTION_CHUNK_KEY].float().cpu().numpy()
                ]
            distribution = policy.get_dist(batch)
            logits = getattr(distribution, "base_dist", distribution).logits  # (B, H, D, tokens)
            # The largest logit after Gumbel noise is that of a draw from their softmax.
            noise = [
                np.zeros(logits[0].shape) if rng is None else rng.gumbel(size=logits[0].shape)
                for _, rng in rows
            ]
            tokens = (logits + torch.from_numpy(np.stack(noise)).to(device, logits.dtype)).argmax(
                -1
            )
            # (B,), or (B, H, D) with `log_probs_mode="token"`.
            logprobs = distribution.log_prob(tokens)
            actions = (
                tokens
                if policy.action_tokenizer is None
                else policy.action_tokenizer.decode(tokens)
            )
        acts = []
        outputs = zip(
            _on_host(actions.float()), _on_host(tokens), _on_host(logprobs.float()), strict=True
        )
        for action, drawn, logprob in outputs:
            behaviour = {"logprob": logprob, REPLAY: {_TOKENS: drawn}}
            acts.append(Act(action, info={BEHAVIOUR: behaviour}))
        return acts


class ServerAddress:
    """The address of a `PolicyServer` that starts later, in the place of TorchRL's
    `MPTransport`.
    """

    def __init__(self, **_of_torchrl: Any) -> None:
        self.port = free_port()

    def client(self) -> ServedPolicy:
        """Return a client, whose first call waits for the server."""
        return ServedPolicy(f"http://127.0.0.1:{self.port}")

    def close(self) -> None:
        """Do nothing, since a server closes its port itself."""


class PolicyServer:
    """A server of a `VLAWrapperBase` on a Ray that it starts, with the arguments of TorchRL's
    `ProcessInferenceServer`.

    `server_config.max_batch_size` limits its batches, which wait as `batch.patience` of deployment
    files states. For a `policy_device` "cuda", Ray reserves a GPU. Other arguments have no meaning
    here.
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
                f"transport: expected ServerAddress, got {type(transport).__name__}; import both "
                "names"
            )
        self.transport = transport
        self._factory = policy_factory
        self._running = ExitStack()
        self._batch = {} if server_config is None else {"max_size": server_config.max_batch_size}
        self._resources = {"num_gpus": float(torch.device(policy_device).type == "cuda")}

    def start(self) -> Self:
        """Serve the policy, and wait until it is loaded."""
        # Processes of environments import this module for the client alone, which does without Ray.
        from ray import cloudpickle

        from vlagents_ray.serve.launch.deployment_file import deployment
        from vlagents_ray.serve.launch.server import running_server
        from vlagents_ray_learn.publisher import Publisher

        with ExitStack() as stack:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="vlr-torchrl-"))
            file = Path(folder) / "factory"
            file.write_bytes(cloudpickle.dumps(self._factory))
            module_path = os.pathsep.join(filter(None, sys.path))  # of the factory's modules
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
        """Push a tensordict of parameters, all or some, for all later acts; raises the errors of
        `Publisher.push`.
        """
        named = dict(weights.flatten_keys(".").items())
        # Lazy layers of a learner have none before its first batch.
        if all(value.numel() for value in named.values()):
            self._publisher.push(named, mode="keep", partial=True, allow_same=True)
        return {"accepted": True}

    def shutdown(self, timeout: float | None = None) -> None:
        """Stop the server and its Ray."""
        self._running.close()


def _without_errors(results: Sequence[Any]) -> Sequence[Any]:
    """Return the results of a batch; raises the first error among them."""
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
    image, state = row.get(IMAGE, None), row.get(STATE, None)
    cameras = {} if image is None else {_CAMERA: _on_host(image.movedim(0, -1).contiguous())}
    parts = {} if state is None else {_STATE_PART: _on_host(state.float())}
    return Obs(cameras, state=parts)


def _row(obs: Obs, session: TorchRLPolicy) -> tuple[Any, np.random.Generator | None]:
    """Return a session's input for the policy, and the generator of its draw, if any."""
    row = optional("tensordict", "torchrl").TensorDict({TEXT: session._instruction}, [])
    if IMAGE in session.policy.in_keys:
        image = camera_images(obs, {_CAMERA: _CAMERA})[_CAMERA]
        row[IMAGE] = torch.from_numpy(image.copy()).movedim(-1, 0)
    if STATE in session.policy.in_keys:
        row[STATE] = torch.from_numpy(state_vector(obs, [_STATE_PART]))
    return row, session._draws if obs.info.get(WANT) else None
