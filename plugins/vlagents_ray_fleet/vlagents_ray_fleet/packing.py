"""The assignment of replicas to GPUs, as an integer program that `scipy.optimize.milp` solves.

All replicas of a model reserve the same share of a GPU, as Ray accepts one number for a deployment.
A *layout* is the possible content of one GPU: replicas with their shares, whose sum is at most 1
and whose memory fits. The program chooses the number of replicas of each model and their share, and
the number of GPUs with each layout. Layouts have no order, so no two solutions differ only in the
order of the GPUs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp

from vlagents_ray.errors import ConfigError

_MOST_LAYOUTS = 20_000  # maximum number of layouts; with more, a solution may take minutes
_LOAD_WEIGHT = 1e-3  # weight of the sum of loads relative to the largest load
_SOLVE_S = 60.0  # time limit for one solution, s


class Piece(NamedTuple):
    """A replica of a model with its share of a GPU."""

    model: str
    parts: int  # the share as a number of equal parts of a GPU


@dataclass(frozen=True)
class Choice:
    """One way to serve a model."""

    piece: Piece
    replicas: int
    load: float  # load of the replica with the highest load


class Layout(NamedTuple):
    """The content of one GPU: the number of replicas by piece."""

    pieces: tuple[tuple[Piece, int], ...]


@dataclass(frozen=True)
class Packing:
    """A solution: the choice of each model, and the number of GPUs with each layout."""

    choices: Mapping[str, Choice]
    layouts: Sequence[tuple[Layout, int]]

    @property
    def gpus(self) -> int:
        """The number of GPUs."""
        return sum(count for _, count in self.layouts)


def layouts(
    pieces: Sequence[Piece], parts: int, memory_gb: Mapping[str, float], gpu_memory_gb: float
) -> list[Layout]:
    """Return all layouts to which no further replica of any piece can be added.

    Args:
        pieces: The pieces to place.
        parts: The number of equal parts of a GPU.
        memory_gb: The memory of a replica of each model, GB.
        gpu_memory_gb: The memory of a GPU, GB.

    Raises:
        ConfigError: There are too many layouts.
    """
    by_model: dict[str, list[Piece]] = {}
    for piece in pieces:
        by_model.setdefault(piece.model, []).append(piece)
    models = list(by_model)

    def extend(index: int, free: int, free_gb: float) -> Iterator[tuple[tuple[Piece, int], ...]]:
        if index == len(models):
            yield ()
            return
        yield from extend(index + 1, free, free_gb)
        for piece in by_model[models[index]]:
            needed_gb = memory_gb[piece.model]
            most = min(free // piece.parts, int(free_gb / needed_gb + 1e-9))
            for count in range(1, most + 1):
                contents_behind = extend(
                    index + 1, free - count * piece.parts, free_gb - count * needed_gb
                )
                for others in contents_behind:
                    yield ((piece, count), *others)

    layouts = []
    for content in extend(0, parts, gpu_memory_gb):
        if _has_room(content, by_model, parts, memory_gb, gpu_memory_gb):
            continue
        layouts.append(Layout(content))
        if len(layouts) > _MOST_LAYOUTS:
            raise ConfigError(
                f"gpus: expected at most {_MOST_LAYOUTS} ways to fill a GPU with these models; "
                "raise finest_fraction, or set gpu_fraction of some models"
            )
    return layouts


def _has_room(
    content: tuple[tuple[Piece, int], ...],
    by_model: Mapping[str, Sequence[Piece]],
    parts: int,
    memory_gb: Mapping[str, float],
    gpu_memory_gb: float,
) -> bool:
    """Return whether a GPU with this content has room for one more replica of some piece."""
    held = {piece.model: piece for piece, _ in content}
    free = parts - sum(piece.parts * count for piece, count in content)
    free_gb = gpu_memory_gb - sum(memory_gb[piece.model] * count for piece, count in content)
    for model, pieces in by_model.items():
        # A model has one piece, so a layout with two different pieces of a model is never used.
        smallest = held[model].parts if model in held else min(piece.parts for piece in pieces)
        if smallest <= free and memory_gb[model] <= free_gb + 1e-9:
            return True
    return False


def fewest_gpus(choices: Sequence[Choice], ways: Sequence[Layout]) -> Packing:
    """Return a packing with the fewest GPUs.

    Args:
        choices: The ways to serve each model; exactly one of each model is chosen.
        ways: The layouts of a GPU.
    """
    cost = np.concatenate([np.zeros(len(choices)), np.ones(len(ways)), [0.0]])
    return _solve(choices, ways, cost, gpus=None)


def least_load(choices: Sequence[Choice], ways: Sequence[Layout], gpus: int) -> Packing:
    """Return the packing on at most `gpus` GPUs with the smallest maximum load of a model."""
    loads = _LOAD_WEIGHT * np.array([choice.load for choice in choices])
    cost = np.concatenate([loads, np.zeros(len(ways)), [1.0]])
    return _solve(choices, ways, cost, gpus)


def _solve(
    choices: Sequence[Choice], ways: Sequence[Layout], cost: np.ndarray, gpus: int | None
) -> Packing:
    """Solve the program. The variables are whether each choice is made, the number of GPUs with
    each layout, and the largest load of a model.
    """
    variables = len(choices) + len(ways) + 1
    models = list(dict.fromkeys(choice.piece.model for choice in choices))
    pieces = list(dict.fromkeys(choice.piece for choice in choices))
    rows: list[np.ndarray] = []
    lowest: list[float] = []
    highest: list[float] = []

    def constrain(row: np.ndarray, low: float, high: float) -> None:
        rows.append(row)
        lowest.append(low)
        highest.append(high)

    for model in models:
        chosen = np.zeros(variables)
        load = np.zeros(variables)
        for index, choice in enumerate(choices):
            if choice.piece.model == model:
                chosen[index] = 1
                load[index] = choice.load
        constrain(chosen, 1, 1)
        load[-1] = -1
        constrain(load, -np.inf, 0)

    for piece in pieces:
        places = np.zeros(variables)
        for index, choice in enumerate(choices):
            if choice.piece == piece:
                places[index] = -choice.replicas
        for index, way in enumerate(ways):
            places[len(choices) + index] = dict(way.pieces).get(piece, 0)
        constrain(places, 0, np.inf)

    if gpus is not None:
        used = np.zeros(variables)
        used[len(choices) : -1] = 1
        constrain(used, 0, gpus)

    integral = np.ones(variables)
    integral[-1] = 0
    upper = np.full(variables, np.inf)
    upper[: len(choices)] = 1
    solution = milp(
        cost,
        constraints=LinearConstraint(np.array(rows), lowest, highest),
        integrality=integral,
        bounds=Bounds(np.zeros(variables), upper),
        options={"time_limit": _SOLVE_S},
    )
    if solution.x is None:
        raise ConfigError(f"the plan has no solution: {solution.message}")

    values = np.round(solution.x).astype(int)
    chosen_ways = {
        choice.piece.model: choice
        for choice, value in zip(choices, values, strict=False)
        if value == 1
    }
    counts = values[len(choices) : -1]
    return Packing(chosen_ways, _without_surplus(chosen_ways, ways, counts))


def _without_surplus(
    choices: Mapping[str, Choice], ways: Sequence[Layout], counts: np.ndarray
) -> list[tuple[Layout, int]]:
    """Return the number of GPUs by layout, without places for more replicas than were chosen."""
    missing = {choice.piece: choice.replicas for choice in choices.values()}
    gpus: dict[Layout, int] = {}
    for way, count in zip(ways, counts, strict=True):
        for _ in range(count):
            held = []
            for piece, places in way.pieces:
                replicas = min(places, missing.get(piece, 0))
                if replicas:
                    missing[piece] -= replicas
                    held.append((piece, replicas))
            if held:
                layout = Layout(tuple(held))
                gpus[layout] = gpus.get(layout, 0) + 1
    return sorted(gpus.items(), key=lambda item: -item[1])
