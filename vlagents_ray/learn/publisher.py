"""A learner's way to the policies that act: `Publisher`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from vlagents_ray.client.credentials import Credentials
from vlagents_ray.errors import ConfigError, InvalidWeights
from vlagents_ray.learn.targets import AppTarget, EngineTarget, ServerTarget, WeightsTarget
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.weights.updates import PushOptions
from vlagents_ray.serve.weights.versions import PushMode

if TYPE_CHECKING:
    from typing_extensions import Self


class Publisher:
    """Gives new weights to a served policy, from the memory of the learner, without a checkpoint on disk.

        with Publisher("serve://pi0") as weights:  # or "https://gpu:8000", with a key of the scope "weights"
            version = weights.push(model.state_dict())
            assert weights.acknowledged(version) == 2  # replicas

    Every replica checks and holds a version before any acts with it, so that a push succeeds everywhere or nowhere.
    """

    def __init__(
        self,
        target: str | Engine,
        *,
        api_key: str | None = None,
        ca: str | os.PathLike[str] | None = None,
        certificate: tuple[str | os.PathLike[str], str | os.PathLike[str]] | None = None,
    ) -> None:
        """Connect to the policy.

        Args:
            target: "serve://APP", from a process in the Ray cluster; the URL of a server, "http(s)://HOST:PORT"; or an
                engine in this process.
            api_key: A key of the scope "weights", for a URL; by default the value of `VLAGENTS_RAY_API_KEY`.
            ca: As for `RemoteAgent`.
            certificate: As for `RemoteAgent`.

        Raises:
            ConfigError: The target is none of these, or this process is in no Ray cluster.
        """
        self._target: WeightsTarget
        if isinstance(target, Engine):
            self._target = EngineTarget(target)
        elif isinstance(target, str) and target.startswith("serve://"):
            self._target = AppTarget(target.removeprefix("serve://").rstrip("/"))
        elif isinstance(target, str) and target.startswith(("http://", "https://")):
            self._target = ServerTarget(target, Credentials(api_key, ca, certificate))
        else:
            raise ConfigError(
                f"Publisher: got {target!r}, want 'serve://APP', 'http(s)://HOST:PORT' or an Engine of this process"
            )

    def push(
        self,
        named: Mapping[str, Any],
        *,
        mode: PushMode = "next_episode",
        partial: bool = False,
        allow_same: bool = False,
        pin: bool = False,
        version: int | None = None,
    ) -> int:
        """Let the policy act with new weights, and return their version once all replicas hold them.

        Args:
            named: The values by name, as `Agent.parameters` names them: numpy or JAX arrays or torch tensors, e.g. a
                `state_dict`. They are copied before this returns, so that the learner can go on.
            mode: When sessions change: at their next reset ("next_episode"), between two acts ("keep"), or once the
                episodes of all sessions of their replica have ended, until when resets wait ("wait").
            partial: Whether names may be missing, whose values stay, as when only adapters are trained.
            allow_same: Whether all values may equal those that the policy holds.
            pin: Whether robots, and others that do not follow, also act with it from their next reset on.
            version: The number of the version, such as the step of training; by default the newest one's + 1.

        Returns:
            The version, as in `act.info["policy"]["version"]`. With "wait", replicas act with it
            later; see `acknowledged`.

        Raises:
            InvalidWeights: The values do not fit the policy; nothing was changed.
            UnchangedWeights: The values equal those that the policy holds.
            InvalidInput: The version is not above the newest one.
            NotTrainable: The policy names no parameters to train.
            Overloaded: Another push is under way.
            PolicyUnavailable: A replica cannot be reached; nothing was changed.
            Forbidden: The API key lacks the scope "weights".
        """
        if not isinstance(named, Mapping):
            raise InvalidWeights(f"weights: got {type(named).__name__}, want values by name, such as a state_dict")
        return self._target.push(named, PushOptions(mode, partial, allow_same, pin, version))

    def acknowledged(self, version: int) -> int:
        """Return the number of replicas that act with this version, or with a later one.

        Args:
            version: The version, as `push` returned it.
        """
        return sum(newest >= version for newest in self._target.versions())

    def close(self) -> None:
        """End the connection; the policy keeps its weights."""
        self._target.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
