"""CALVIN's thousand chains of five tasks, and the states in which they begin, as its own code in a checkout has them.

That code imports torch, lightning and pyhash at its top, of which the chains need one hash function: its definitions
are executed here without the imports.
"""

from __future__ import annotations

import ast
import contextlib
import copy
import functools
import itertools
import logging
import math
import multiprocessing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

NUMBER = 1000
_LENGTH = 5
_EVALUATION = Path("calvin_models/calvin_agent/evaluation")
_FNV_PRIME = 0x01000193


@dataclass(frozen=True, slots=True)
class Chain:
    """What an episode consists of."""

    tasks: tuple[str, ...]  # CALVIN's names, e.g. "open_drawer"
    robot: np.ndarray  # (15,) its `robot_obs`
    scene: np.ndarray  # (24,) its `scene_obs`


class Chains:
    """The chains by their number, as `get_sequences(1000)` orders them.

    CALVIN draws tasks at random until enough of the draws can be done one after another, for each of 192 initial states
    with a seed of its own. That takes minutes for all; here the draws of a state are made when one of its chains is
    asked for.
    """

    def __init__(self, checkout: Path) -> None:
        """Read the code in `checkout`, a checkout of CALVIN."""
        evaluation = checkout / _EVALUATION
        utils = _definitions(
            evaluation / "utils.py",
            contextlib=contextlib,
            logging=logging,
            np=np,
            pi=math.pi,
            pyhash=SimpleNamespace(fnv1_32=lambda: fnv1_32),
        )
        self._state_of = utils["get_env_state_for_initial_condition"]
        self._rules = rules = _definitions(
            evaluation / "multistep_sequences.py",
            ProcessPoolExecutor=_Places,
            deepcopy=copy.deepcopy,
            functools=functools,
            logging=logging,
            multiprocessing=multiprocessing,
            np=np,
            product=itertools.product,
            temp_seed=utils["temp_seed"],
        )
        self._order: list[tuple[Mapping[str, Any], tuple[int, int]]] = rules["get_sequences"](NUMBER)
        self._drawn: dict[int, tuple[np.random.RandomState, list[tuple[str, ...]]]] = {}

    def __getitem__(self, number: int) -> Chain:
        state, (seed, place) = self._order[number]
        names, check = list(self._rules["tasks"]), self._rules["check_sequence"]
        random, found = self._drawn.setdefault(seed, (np.random.RandomState(seed), []))
        while len(found) <= place:
            drawn = tuple(names[i] for i in random.permutation(len(names))[:_LENGTH])  # as `choice` without replacement
            if check(state, drawn):
                found.append(drawn)
        return Chain(found[place], *self._state_of(state))


class _Places:
    """Stands for the pool of processes: in place of a state's chains it returns the seed and the place of each."""

    def __init__(self, max_workers: int) -> None:
        pass

    def __enter__(self) -> _Places:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def map(self, _: Callable[..., Any], jobs: Iterable[tuple[Any, int, int]]) -> list[list[np.ndarray]]:
        return [[np.array([seed, place]) for place in range(count)] for _, count, seed in jobs]


def fnv1_32(text: str) -> int:
    """Return pyhash's FNV-1, which begins with 0."""
    found = 0
    for byte in text.encode():
        found = (found * _FNV_PRIME % 2**32) ^ byte
    return found


def _definitions(path: Path, **given: Any) -> dict[str, Any]:
    """Execute a module of the checkout without its imports, whose names are `given`."""
    tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
    tree.body = [node for node in tree.body if not isinstance(node, ast.Import | ast.ImportFrom)]
    names = {"__name__": path.stem, **given}
    exec(compile(tree, str(path), "exec"), names)  # noqa: S102 - it is the simulator's code, which is run in any case
    return names
