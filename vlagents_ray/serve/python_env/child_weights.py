"""The versions of the weights of a policy in a child process."""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, BinaryIO
from weakref import WeakKeyDictionary, finalize

import numpy as np

from vlagents_ray.errors import NotTrainable
from vlagents_ray.interface import Agent
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.python_env.child_connection import ChildConnection
from vlagents_ray.serve.weights import ModelWeights, PushOptions, WeightsVersion
from vlagents_ray.weights.safetensors import ValueSpec, read_values, write_values
from vlagents_ray.weights.shared_values import NotShared, SharedValues
from vlagents_ray.weights.trainable import portable, require_fit


class ChildWeights(ModelWeights):
    """The versions of the weights in a child process, whose values stay there, on its GPU.

    This process decides which version is used, and the child makes versions while the policy
    computes.
    """

    def __init__(
        self,
        agent: Agent,
        child: ChildConnection,
        busy: threading.Lock,
        digest: str,
        model: tuple[str, str],
    ) -> None:
        trained = child.policy.trained
        super().__init__(agent, busy, trained.get("fingerprint", digest), model)
        self._child = child
        self._numbers = itertools.count(1)
        # Names of the versions in the child.
        self._names: WeakKeyDictionary[WeightsVersion, int] = WeakKeyDictionary()
        if "refusal" in trained:
            self._refusal = NotTrainable(trained["refusal"])
            return

        self._refusal = None
        self.gpus = tuple(trained["gpus"])
        self._name(self.newest, 0)
        self.newest.values = {
            name: ValueSpec(np.dtype("V2" if dtype == "bfloat16" else dtype), tuple(shape))
            for name, (dtype, shape) in trained["values"].items()
        }

    def make(
        self,
        number: int,
        newest: WeightsVersion,
        pushed: Mapping[str, Any] | SharedValues,
        options: PushOptions,
    ) -> WeightsVersion:
        """Make a version in the child from new values, which are sent in a file in memory or shared
        on the GPU.
        """
        name = next(self._numbers)
        if isinstance(pushed, SharedValues):
            shared = pushed.to_json()
            copied = pushed.others
        else:
            shared = None
            copied = pushed
            # The values are checked before any of them is copied.
            require_fit(newest.values or {}, pushed, partial=options.partial)

        with _memory_file() as file:
            write_values(file, {key: portable(value) for key, value in copied.items()})
            answer = self._child.call_for_weights(
                "make_weights",
                name=name,
                base=self._names[newest],
                number=number,
                file=_path(file),
                options=asdict(options),
                shared=shared,
            )
        if "not_shared" in answer:
            raise NotShared(answer["not_shared"])

        version = WeightsVersion(number, answer["fingerprint"], newest.values)
        self._name(version, name)
        return version

    def use(self, version: WeightsVersion) -> None:
        """Make the policy act with a version."""
        if version is not self._live and version in self._names:
            self._live = None
            self._child.ask(Request("weights", kwargs={"use": self._names[version]}))
            self._live = version

    def sleep(self, *, offload: bool) -> None:
        self._child.call_for_weights("sleep", offload=offload)

    def wake(self) -> None:
        self._child.call_for_weights("wake")

    def portable_values(self, version: WeightsVersion) -> dict[str, Any]:
        with _memory_file() as file:
            self._child.call_for_weights(
                "read_weights", name=self._names[version], file=_path(file)
            )
            return dict(read_values(file))

    def _name(self, version: WeightsVersion, name: int) -> None:
        self._names[version] = name
        finalize(version, self._child.drop, name).atexit = False


def _memory_file() -> BinaryIO:
    """Return a file in memory that is freed when it is closed, even if the other
    process crashes.
    """
    return os.fdopen(os.memfd_create("vlagents_weights"), "w+b")


def _path(file: BinaryIO) -> str:
    return f"/proc/{os.getpid()}/fd/{file.fileno()}"
