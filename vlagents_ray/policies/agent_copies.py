"""Copies of an initialized agent: the private state of each session.

A policy is initialized once per replica. Every `reset` begins with a pristine copy of that
initialized agent, so that neither other sessions nor earlier episodes of the session influence an
episode. A copy shares objects that are large or cannot be copied, and owns everything else:

- Shared: attributes named in `Agent.shared`, torch parameters, JAX arrays (immutable), functions,
  classes, modules, and objects that cannot be copied (locks, sockets, native handles).
- Shared and made read-only: numpy arrays of 64 MiB and more, so that writing into such an array
  raises an error instead of changing other sessions.
- Copied: all other attributes, at any depth.

When a session moves to another replica of the same policy, its copied state is sent there; the new
replica looks up the shared objects by their index.
"""

from __future__ import annotations

import hashlib
import io
import logging
import pickle
import sys
import types
from typing import Any

import numpy as np

from vlagents_ray.interface import Agent

logger = logging.getLogger(__name__)

SHARED_ARRAY_BYTES = 64 * 2**20

_BY_REFERENCE = (
    types.FunctionType,
    types.BuiltinFunctionType,
    types.ModuleType,
    type,
    logging.Logger,
)
_PLAIN = (
    *(
        type(None),
        bool,
        int,
        float,
        complex,
        str,
        bytes,
        bytearray,
        list,
        tuple,
        dict,
        set,
        frozenset,
    ),
    pickle.PickleBuffer,  # the data of a numpy array
)


class _Shared:
    """The objects that the sessions of a replica share, in the order of pickling."""

    def __init__(self) -> None:
        self.objects: list[Any] = []
        self.refused: set[str] = set()
        self.numbers: dict[int, int] = {}  # indices in `objects` by id
        torch = sys.modules.get("torch")
        self._parameter: type | None = torch.nn.Parameter if torch is not None else None

    def add(self, obj: Any) -> int:
        """Add an object to the shared objects, and return its index."""
        number = self.numbers.get(id(obj))
        if number is None:
            number = self.numbers[id(obj)] = len(self.objects)
            self.objects.append(obj)
        return number

    def must_have(self, obj: Any) -> bool:
        """Return whether copies must share the object, even if `Agent.shared` does not name it.

        A large array is made read-only.
        """
        if isinstance(obj, _BY_REFERENCE) or (
            self._parameter is not None and isinstance(obj, self._parameter)
        ):
            return True
        if isinstance(obj, np.ndarray):
            if obj.nbytes < SHARED_ARRAY_BYTES:
                return False
            obj.flags.writeable = False
            return True
        if type(obj).__module__.partition(".")[0] in ("jax", "jaxlib"):
            return True
        try:
            obj.__reduce_ex__(pickle.HIGHEST_PROTOCOL)
        except Exception:  # noqa: BLE001 - an object that raises any error here cannot be copied
            self.refused.add(f"{type(obj).__module__}.{type(obj).__qualname__}")
            return True
        return False

    def fingerprint(self) -> str:
        """Return a digest that is equal in replicas whose shared objects have the same types,
        names and shapes.
        """
        kinds = [
            (
                type(obj).__module__,
                type(obj).__qualname__,
                getattr(obj, "__qualname__", ""),
                str(_shape(obj)),
            )
            for obj in self.objects
        ]
        return hashlib.sha256(repr(kinds).encode()).hexdigest()


class _Pickler(pickle.Pickler):
    """Pickles an agent in memory without its shared objects. With `find`, objects that must be
    shared are added to the shared objects.
    """

    def __init__(self, file: io.BytesIO, shared: _Shared, *, find: bool) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self._shared, self._find = shared, find

    def persistent_id(self, obj: Any) -> int | None:
        """Return the index of a shared object, or None for an object that is copied."""
        number = self._shared.numbers.get(id(obj))
        if (
            number is None
            and self._find
            and type(obj) not in _PLAIN
            and self._shared.must_have(obj)
        ):
            number = self._shared.add(obj)
        return number


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, shared: _Shared) -> None:
        super().__init__(io.BytesIO(data))
        self._objects = shared.objects

    def persistent_load(self, pid: Any) -> Any:
        return self._objects[pid]


class AgentCopies:
    """Makes copies of an initialized agent that are independent of each other."""

    def __init__(self, agent: Agent) -> None:
        self._shared = _Shared()
        for item in agent.shared_objects():
            if type(item) not in _PLAIN or item:
                self._shared.add(item)
        self._pristine = self.dump(agent, find=True)
        self.fingerprint = self._shared.fingerprint()
        if self._shared.refused:
            logger.warning(
                "%s: sessions share objects of %s, which cannot be copied; if such an object "
                "contains the state of an episode, create it in reset() instead of initialize()",
                type(agent).__name__,
                sorted(self._shared.refused),
            )

    def make(self) -> Agent:
        """Return a pristine copy: the agent in its state after `initialize`."""
        return self.load(self._pristine)

    def dump(self, agent: Agent, *, find: bool = False) -> bytes:
        """Pickle the private state of a copy, for `load` in another replica.

        Args:
            agent: The copy.
            find: Whether to add the objects that copies must share to the shared objects.

        Raises:
            Exception: Any error of pickling.
        """
        file = io.BytesIO()
        _Pickler(file, self._shared, find=find).dump(agent)
        return file.getvalue()

    def load(self, data: bytes) -> Agent:
        """Return the copy that `dump` wrote, in this replica or in another replica with the same
        fingerprint.
        """
        agent: Agent = _Unpickler(data, self._shared).load()
        return agent


def _shape(obj: Any) -> tuple[int, ...] | None:
    shape = getattr(obj, "shape", None)
    return tuple(shape) if isinstance(shape, tuple) else None
