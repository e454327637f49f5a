"""The one model that a replica serves: its loading, its replacement by a model with other settings,
and the facts about it.

A replacement happens in place, since an accelerator may have no memory for two models: the sessions
of the old model end, the old agent is closed and its memory freed, and only then is the next model
loaded. No episode therefore acts with two models. Meanwhile, and after an error, there is none.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from vlagents_ray.abilities import ChecksHealth, ability
from vlagents_ray.contract import Contract
from vlagents_ray.errors import NoReplica
from vlagents_ray.policies.base.accelerator import free_memory, gpu_memory
from vlagents_ray.policies.base.checkpoint import checkpoint_name
from vlagents_ray.policies.base.program import Program
from vlagents_ray.serve.models.loaded_model import ComputesElsewhere, GpuWork, LoadedModel, Loader
from vlagents_ray.serve.sessions import SessionTable
from vlagents_ray.serve.weights import ModelWeights

logger = logging.getLogger(__name__)

_CLOSE_S = 10.0  # longest wait for the running batch when the replica stops, s


class ServedModel:
    """The model of a replica, from loading it to releasing its memory.

    Only the policy's thread calls `load`, so that the agent is created, initialized and used by one
    thread; all other methods may be called on any thread.
    """

    def __init__(
        self,
        config: Mapping[str, Any],
        loader: Loader,
        sessions: SessionTable[LoadedModel],
        on_step: Callable[[str], None] | None = None,
    ) -> None:
        """Create it without a model.

        Args:
            config: The settings of the policy.
            loader: Loads models.
            sessions: The sessions of the replica, which end with their model.
            on_step: Called with each step of a long load, on the thread that loads.
        """
        self.config = dict(config)  # the settings of the model, or of the one that is being loaded
        self.step = ""  # the step of a long load, such as "compiling 4 rows (3 of 5)"
        self._loader, self._sessions, self._on_step = loader, sessions, on_step
        self._loaded: LoadedModel | None = None

    def load(self, config: Mapping[str, Any] | None = None) -> None:
        """Load the model, in place of the loaded one.

        Args:
            config: The settings of the policy from now on; None for the present settings.

        Raises:
            BaseException: The model cannot be loaded or served. There is no model then.
        """
        self._unload()
        if config is not None:
            self.config = dict(config)
        self.step = ""

        begun = time.monotonic()
        try:
            self._loaded = self._loader.load(self.config, self._set_step)
        except BaseException:
            free_memory()
            raise
        logger.info("loaded %s in %.1f s", self.checkpoint, time.monotonic() - begun)

    def _unload(self) -> None:
        """Close the loaded model and its sessions, and free its memory."""
        model, self._loaded = self._loaded, None
        if model is None:
            return
        logger.info("unloading %s", self.checkpoint)
        self._sessions.close_all()
        model.close()
        del model
        free_memory()

    def close(self) -> None:
        """Close the model, unless its running batch does not end. Its facts stay known, for the
        parts that close after the engine.
        """
        model = self._loaded
        if model is not None:
            model.close(_CLOSE_S)

    def _set_step(self, step: str) -> None:
        self.step = step
        if self._on_step is not None:
            self._on_step(step)

    @property
    def loaded(self) -> LoadedModel | None:
        """The loaded model; None while a model is being loaded, or if it did not load."""
        return self._loaded

    def require_loaded(self) -> LoadedModel:
        """Return the loaded model; raise `NoReplica` if there is none."""
        model = self._loaded
        if model is None:
            raise self.loading()
        return model

    def loading(self) -> NoReplica:
        """Return the error for clients while a model is loaded. The error contains the current step
        of loading.
        """
        return NoReplica(f"the policy is loading{self.step and f' ({self.step})'}; try again")

    def check_health(self) -> None:
        """Raise the error of the agent's own health check."""
        model = self._loaded
        checks = None if model is None else ability(model.agent, ChecksHealth)
        if checks is not None:
            checks.check_health()

    # The facts about the model, for the metadata and the metrics. Without a model, they are empty.

    @property
    def checkpoint(self) -> str | None:
        """Name of the checkpoint in the settings; None if the settings name none."""
        return checkpoint_name(self.config)

    @property
    def version(self) -> tuple[str, str]:
        """Version of the policy, which is equal in replicas of the same policy with
        equal settings.
        """
        model = self._loaded
        return (self._loader.version(self.config), "") if model is None else model.version

    @property
    def own_weights(self) -> ModelWeights:
        """Versions of the model's weights; raises `NoReplica` if there is no model."""
        return self.require_loaded().parameters

    @property
    def contract(self) -> Contract | None:
        """Contract of the model; None if it has no contract."""
        model = self._loaded
        return None if model is None else model.contract

    @property
    def weights(self) -> dict[str, Any] | None:
        """Digest, revision, statistics and measured success of the loaded weights, see
        `LoadedModel.weights`.
        """
        model = self._loaded
        return None if model is None else model.weights

    @property
    def files(self) -> Program:
        """Digests of the files that the settings name."""
        model = self._loaded
        return {} if model is None else model.files

    @property
    def devices(self) -> list[dict[str, Any]]:
        """Devices of the model."""
        model = self._loaded
        return [] if model is None else model.report.devices

    @property
    def passes(self) -> dict[str, Any]:
        """The forward passes on which the bits of actions depend: whether they are `invariant`, and
        if so the number of their `rows`.
        """
        model = self._loaded
        if model is None or model.variation is not None:
            return {"invariant": False}
        return {"invariant": True, "rows": model.report.batch_sizes[-1]}

    @property
    def variation(self) -> str | None:
        """Why the bits of an action may depend on its batch; None if they do not."""
        model = self._loaded
        return "no model is loaded" if model is None else model.variation

    @property
    def uncompiled(self) -> list[str]:
        """The parts of the model that run without compilation, although its settings request it."""
        model = self._loaded
        return [] if model is None else model.report.uncompiled

    @property
    def continues_plans(self) -> bool:
        """Whether chunks continue the executed plan."""
        model = self._loaded
        return model is not None and model.continues_plans

    @property
    def longest_prefix(self) -> int:
        """Maximum number of rows of the executed plan that a chunk repeats exactly at its
        beginning; 0 for none.
        """
        model = self._loaded
        return 0 if model is None else model.longest_prefix

    def gpu_memory(self) -> dict[str, int]:
        """Return the memory of the model's GPUs, see `accelerator.gpu_memory`; "free" is the least
        of the amounts that the processes can allocate there.
        """
        by_process = [gpu_memory(self.devices)]
        elsewhere = self._agent_elsewhere()
        if elsewhere is not None:
            by_process.append(elsewhere.gpu_memory())

        total = Counter[str]()
        for memory in by_process:
            total.update(memory)
        free = [memory["free"] for memory in by_process if memory]
        return {**total, "free": min(free)} if free else {}

    def gpu_work_elsewhere(self) -> GpuWork | None:
        """Return the GPU work of the model's other process since the last call; None if it computes
        in this process.
        """
        elsewhere = self._agent_elsewhere()
        return None if elsewhere is None else elsewhere.gpu_work()

    def software_elsewhere(self) -> Program | None:
        """Return the software of the model's other process; None if it computes in this process."""
        elsewhere = self._agent_elsewhere()
        return None if elsewhere is None else elsewhere.software()

    def _agent_elsewhere(self) -> ComputesElsewhere | None:
        """Return the agent, if it computes in another process."""
        model = self._loaded
        agent = None if model is None else model.agent
        return agent if isinstance(agent, ComputesElsewhere) else None
