"""The trials of an evaluation on a robot: balanced, and in an order that the plan's key draws."""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Iterable
from dataclasses import dataclass

from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import canonical
from vlagents_ray.evaluate.plan.jobs import EpisodeKey, Job
from vlagents_ray.naming import plain


@dataclass(frozen=True, slots=True)
class Trial:
    """A trial, and what its operator must not see: the policy, which is `job.cell.policy`."""

    number: int  # from 1, in the order in which they are played
    scene: int  # from 1; each policy plays each scene of a task once
    job: Job

    @property
    def task(self) -> tuple[str, str]:
        """(suite, env)."""
        return self.job.cell.suite.name, self.job.cell.env

    @property
    def place(self) -> str:
        """The name of the scene in files."""
        return plain("-".join((*filter(None, self.task), f"scene{self.scene}")))


def schedule(cells: Iterable[EvalCase], key: bytes) -> list[Trial]:
    """Draw the order of all trials: task by task, scene by scene, and in each scene every policy once.

    With k policies, each k scenes in a row (of one seed) have the rows of a k x k Latin square in a drawn order, whose
    columns are the policies in a drawn order. So each policy is first, second, and so on equally often in them, and
    after an incomplete rest the counts differ by one at most. What is drawn depends on the key, the names of policies,
    suites and environments, and the seeds, by HMAC-SHA256.

    Args:
        cells: The cells of the plan, all on a robot.
        key: Who has it knows which policy plays in which trial.

    Returns:
        The trials in the order in which they are played.
    """
    tasks: dict[tuple[str, str], dict[str, EvalCase]] = {}
    for cell in cells:
        tasks.setdefault((cell.suite.name, cell.env), {})[cell.contender] = cell
    trials: list[Trial] = []
    for task, contenders in tasks.items():
        suite = next(iter(contenders.values())).suite
        for place, seed in enumerate(suite.seeds):
            for i in range(suite.episodes):
                block, row = divmod(i, len(contenders))
                columns = _drawn(key, [*task, seed, block, "policy"], contenders)
                shifts = _drawn(key, [*task, seed, block, "row"], map(str, range(len(contenders))))
                shift = int(shifts[row])
                for name in columns[shift:] + columns[:shift]:
                    cell = contenders[name]
                    job = Job(EpisodeKey(cell.env, i, seed + i, cell.fingerprint), cell)
                    trials.append(Trial(len(trials) + 1, place * suite.episodes + i + 1, job))
    return trials


def _drawn(key: bytes, what: list[str | int], names: Iterable[str]) -> list[str]:
    """The names in the order of their authentication codes, whatever order they have in the plan."""
    return sorted(names, key=lambda name: hmac.digest(key, canonical([*what, name]).encode(), hashlib.sha256))
