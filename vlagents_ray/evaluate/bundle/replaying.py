"""Plays some of a bundle's episodes again by their recorded actions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.evaluate.artifacts.trajectory import Trajectory
from vlagents_ray.evaluate.bundle.actions import Replayed, replay_actions, require_harmless
from vlagents_ray.evaluate.bundle.consistency import recorded
from vlagents_ray.evaluate.bundle.finding import Finding
from vlagents_ray.evaluate.results.reader import CellResults, Episode, Results

_SHOWN = 80  # characters of a value


def check_replays(results: Results, most: int, *, trust: bool) -> Iterator[Finding]:
    """Play the recorded actions of up to `most` episodes, of as many cells as possible.

    Args:
        results: Those of the bundle.
        most: The number of episodes.
        trust: Whether environments that are not registered, and options that could name files, are taken.
    """
    if not most:
        yield Finding("replay", "not checked", "was not asked for (--replay 0)")
        return
    chosen = _chosen(results, most)
    if not chosen:
        yield Finding("replay", "not checked", "no finished episode has a recording (eval --record all)")
    for cell, episode, trajectory in chosen:
        yield _replay(cell, episode, trajectory, trust=trust)


def _chosen(results: Results, most: int) -> list[tuple[CellResults, Episode, Trajectory]]:
    """The first episode with a recording of each cell in turns, then the second of each, and so on."""
    left = [
        (cell, iter([one for one in cell.episodes if one.result.status == "done" and one.trajectory is not None]))
        for cell in results.cells
    ]
    found: list[tuple[CellResults, Episode, Trajectory]] = []
    while left and len(found) < most:
        for pair in list(left):
            cell, episodes = pair
            one = next(episodes, None)
            if one is None:
                left.remove(pair)
            elif len(found) < most and (trajectory := recorded(results, one)) is not None:
                found.append((cell, one, trajectory))
    return found


def _replay(cell: CellResults, episode: Episode, trajectory: Trajectory, *, trust: bool) -> Finding:
    subject = f"replay of {cell.env}#{episode.result.key.episode}@{episode.result.key.seed}"
    if cell.settings.get("robot") is not None:
        return Finding(subject, "not checked", "it was played on a real robot")
    try:
        if not trust:
            require_harmless(cell)
        played = replay_actions(cell, episode, trajectory)
    except VLAgentsError as error:
        return Finding(subject, "not checked", str(error))
    result = episode.result
    if played.outcome != (result.success_once, result.success_at_end, result.first_success):
        now = "solved" if played.outcome[0] else "not solved"
        return Finding(subject, "differs", f"{now} here, {_outcome(result.success_once)} there; {_from(played)}")
    detail = f"{played.steps} actions, every state, reward and success to the bit"
    if not played.same:
        detail = f"the same outcome, other numbers; {_from(played)}"
    if odd := _described(cell.described, played.described):
        detail += f"; the environment says of itself here: {odd}"
    return Finding(subject, "equal" if played.same else "other here", detail)


def _from(played: Replayed) -> str:
    return f"the numbers differ from step {played.differs_from} of {played.steps} on, by at most {played.largest:.3g}"


def _outcome(solved: bool | None) -> str:
    return "solved" if solved else "not solved"


def _described(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    odd = [
        f"{name} {str(here.get(name))[:_SHOWN]}, there {str(there.get(name))[:_SHOWN]}"
        for name in sorted(there.keys() | here.keys())
        if there.get(name) != here.get(name)
    ]
    return "; ".join(odd)
