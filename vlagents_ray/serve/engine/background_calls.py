"""Calls for the loaded policy and its weights that run while the policy computes actions.

The replica of a child process sends them to the engine in the child
(`vlagents_ray.serve.python_env.child_connection`), as requests with the operations
`BACKGROUND_OPS`. They are not queued, since a push of weights would wait for the running batch.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from vlagents_ray.errors import PolicyFailed
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.ability_call import AbilityCall
from vlagents_ray.serve.engine.parts import EngineParts
from vlagents_ray.serve.engine.responses import public_error, require_serializable
from vlagents_ray.serve.requests import PendingRequest
from vlagents_ray.serve.weights import PushOptions
from vlagents_ray.weights.safetensors import read_values, write_values
from vlagents_ray.weights.shared_values import NotShared, SharedValues


class BackgroundCalls:
    """Executes background calls, one after the other, on a separate thread. Thread-safe."""

    def __init__(self, parts: EngineParts) -> None:
        self._model = parts.model
        self._weights = parts.weights
        self._reply_bytes = parts.settings.reply_bytes
        self._thread = ThreadPoolExecutor(1, "policy-background")  # started by the first call

    def submit(self, pending: PendingRequest) -> None:
        """Execute the call of a request that was checked, and answer the request."""
        self._thread.submit(self._answer, pending)

    def close(self) -> None:
        """Drop the calls that have not begun."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _answer(self, pending: PendingRequest) -> None:
        try:
            info = self._execute(pending.request)
            require_serializable(info, self._reply_bytes)
        except Exception as error:  # noqa: BLE001 - becomes the reply
            pending.fail(public_error(error, pending))
        except BaseException as error:  # noqa: BLE001 - a policy that calls sys.exit()
            pending.fail(PolicyFailed(f"the policy raised {type(error).__name__}"))
        else:
            pending.finish(Reply(pending.request.request_id, info=info))

    def _execute(self, request: Request) -> dict[str, Any]:
        """Return the info of the reply, or raise the error in it."""
        if request.op == "ability":
            return self._use_ability(AbilityCall(**request.kwargs))
        if request.op == "make_weights":
            return self._make_weights(**request.kwargs)
        if request.op == "read_weights":
            self._read_weights(**request.kwargs)
        elif request.op == "sleep":
            self._weights.current().sleep(offload=request.kwargs["offload"])
        else:
            self._weights.current().wake()
        return {}

    def _use_ability(self, call: AbilityCall) -> dict[str, Any]:
        """Return whether the loaded policy has an ability, or the result of a call."""
        agent = self._model.require_loaded().agent
        if not call.member:
            return {"available": call.is_available(agent)}
        return {"result": call.execute(agent, None)}

    def _make_weights(
        self,
        name: int,
        base: int,
        number: int,
        file: str,
        options: dict[str, Any],
        shared: dict[str, Any] | None,
    ) -> dict[str, Any]:
        """Make a version of the weights.

        Args:
            name: Name of the version, with which later calls refer to it.
            base: The name of the version with the values that were not pushed.
            number: Number of the version.
            file: The file in memory with the pushed values, as safetensors.
            options: The fields of `PushOptions`.
            shared: `SharedValues.to_json` of the pushed values that are not in the file, if any.

        Returns:
            The fingerprint of the version, or the reason why the values cannot be shared.
        """
        with Path(file).open("r+b") as values_file:
            copied = read_values(values_file)
        pushed = copied if shared is None else SharedValues.from_json(shared, copied)
        try:
            digest = self._weights.make(name, base, number, pushed, PushOptions(**options))
        except NotShared as error:
            return {"not_shared": str(error)}
        return {"fingerprint": digest}

    def _read_weights(self, name: int, file: str) -> None:
        """Write the values of a version to a file in memory, as safetensors."""
        version = self._weights.version_named(name)
        with Path(file).open("r+b") as values_file:
            write_values(values_file, self._weights.current().portable_values(version))
