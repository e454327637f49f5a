"""How success comes with time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from vlagents_ray.errors import InvalidInput
from vlagents_ray.evaluate.statistics.rates import Rate


@dataclass(frozen=True, slots=True)
class SuccessCurve:
    """The share of episodes solved by each env step: constant between `steps`, a jump at each."""

    steps: tuple[int, ...]  # from 0, those after which an episode was first solved, and the last
    solved: tuple[Rate, ...]  # by then


def success_curve(first_successes: Sequence[int | None], horizon: int) -> SuccessCurve:
    """The curve of episodes that were first solved after so many steps, or never (None), up to `horizon` steps.

    E. L. Kaplan, P. Meier, "Nonparametric Estimation from Incomplete Observations", JASA 53 (1958): their estimate
    where nothing is censored. An episode that ended unsolved, at the step limit, by an error or by the policy's own
    word, will not be solved any more, so it stays in the denominator; leaving it out as censored would claim that it
    might have been. The band is Wilson's interval at each step by itself, and so at the end the interval of the rate.
    """
    known = [step for step in first_successes if step is not None]
    if any(not 0 < step <= horizon for step in known):
        raise InvalidInput(f"success_curve: got steps from {min(known)} to {max(known)}, want them in 1 … {horizon}")
    steps = sorted({0, *known, horizon})
    n = len(first_successes)
    return SuccessCurve(tuple(steps), tuple(Rate(sum(one <= step for one in known), n) for step in steps))
