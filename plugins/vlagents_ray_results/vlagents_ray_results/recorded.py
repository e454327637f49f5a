"""The episodes of results that have a trajectory, which exports of datasets write."""

from __future__ import annotations

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.results.reader import CaseResults, Episode, Results


def recorded_episodes(results: Results) -> list[tuple[CaseResults, Episode]]:
    """Return each episode that has a trajectory, with its case.

    Raises:
        ConfigError: No episode has a trajectory.
    """
    recorded = []
    for case in results.cases:
        recorded += [(case, episode) for episode in case.episodes if episode.trajectory is not None]
    if not recorded:
        raise ConfigError(
            f"{results.out}: expected trajectories, got none; evaluate with --record all "
            "(`record: all` in its file)"
        )
    return recorded
