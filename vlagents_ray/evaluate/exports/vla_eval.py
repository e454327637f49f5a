"""Results as entries of vla-eval's leaderboard, `leaderboard/data/leaderboard.json` of its repository.

The format is that of vla-eval 0.8.0 (leaderboard.schema.json, and the rules of each benchmark's page), whose
`leaderboard/scripts/validate.py` accepts what is written here.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.storage import whole
from vlagents_ray.evaluate.exports.scores import Score, scores
from vlagents_ray.evaluate.results.reader import CellResults, Results, rate_of
from vlagents_ray.registry import env_suite, env_task

# LIBERO's suites and their tasks; the overall score is the mean of the first four (its leaderboard's page).
_LIBERO = {"libero_spatial": 10, "libero_object": 10, "libero_goal": 10, "libero_10": 10, "libero_90": 90}
_LIBERO_MEAN = ("libero_spatial", "libero_object", "libero_goal", "libero_10")
# SIMPLER's Bridge tasks by ManiSkill's id; the leaderboard has no overall score of SIMPLER.
_WIDOWX = {
    "PutCarrotOnPlateInScene-v1": "put_carrot_on_plate_vm",
    "PutEggplantInBasketScene-v1": "put_eggplant_in_basket_vm",
    "PutSpoonOnTableClothInScene-v1": "put_spoon_on_towel_vm",
    "StackGreenCubeOnYellowCubeBakedTexInScene-v1": "stack_block_vm",
}
_BENCHMARKS = {"libero": "libero", "simpler": "simpler_env"}


class VlaEvalSettings(BaseModel):
    """What the leaderboard asks for, and the results do not know."""

    model_config = ConfigDict(extra="forbid")

    curated_by: str = Field(pattern=r"^@[\w-]+$")  # your handle on GitHub
    weight_type: Literal["shared", "finetuned"]  # one checkpoint for all benchmarks, or one trained on this benchmark
    model: str | None = None  # key, as kim24openvla; None: the policy's name
    display_name: str | None = None  # None: the policy's name
    params: str | None = None  # "7B"
    model_paper: str | None = None  # URL of the paper that introduces the model
    reported_paper: str | None = None  # URL of the paper that reports these numbers


def to_vla_eval(results: Results, path: Path, **settings: Any) -> int:
    """Write a file as vla-eval's `leaderboard.json`, with one entry for each benchmark.

    An overall score is only given for the standard protocol: all tasks of LIBERO's four suites, with every planned
    episode, no deviation and no real-time mode. Else the entry has the scores of the parts, and `notes` say why.

    Args:
        results: Of one policy id, in LIBERO or SIMPLER.
        path: The file.
        settings: The fields of `VlaEvalSettings`.

    Returns:
        The number of episodes that the entries count.

    Raises:
        ConfigError: There are several policy ids, or an env of a benchmark that the leaderboard does not have.
    """
    given = VlaEvalSettings.model_validate(settings)
    by_benchmark: dict[str, list[Score]] = {}
    for score in scores(results):
        suite = env_suite(score.cells[0].env)
        if suite not in _BENCHMARKS:
            raise ConfigError(
                f"{score.name}: vla-eval's leaderboard has no such benchmark, want {sorted(_BENCHMARKS)}; choose with "
                f"--env, or use another format"
            )
        by_benchmark.setdefault(_BENCHMARKS[suite], []).append(score)
    entries = [_entry(name, found, given) for name, found in sorted(by_benchmark.items())]
    document = {"last_updated": max(str(one["date_added"]) for one in entries), "results": entries}
    with whole(path) as part:
        part.write_text(json.dumps(document, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    return sum(score.rate.episodes for found in by_benchmark.values() for score in found)


def _entry(benchmark: str, found: list[Score], given: VlaEvalSettings) -> dict[str, Any]:
    name = found[0].results.contenders[0]
    parts = _libero(found) if benchmark == "libero" else _simpler(found)
    odd = list(dict.fromkeys(text for score in found for text in score.deviations))
    overall = parts.pop("overall_score", None)
    if odd:
        overall = None
    return {
        "model": given.model or re.sub(r"\W+", "_", name),
        "display_name": given.display_name or name,
        "name_in_paper": None,
        "params": given.params,
        "model_paper": given.model_paper,
        "benchmark": benchmark,
        "weight_type": given.weight_type,
        "overall_score": overall,
        **parts,
        "reported_paper": given.reported_paper,
        "reported_table": None,
        "curated_by": given.curated_by,
        "date_added": max(score.date for score in found).date().isoformat(),
        "notes": " | ".join(f"{score.name}: {score.note}" for score in found),
    }


def _libero(found: list[Score]) -> dict[str, Any]:
    """The suites all of whose tasks were played; tasks of others by themselves."""
    tasks = _by_task(found)
    suites: dict[str, float] = {}
    rest: dict[str, float] = {}
    for suite, number in _LIBERO.items():
        mine = {task: rate for task, rate in tasks.items() if task.partition("/")[0] == suite}
        if len(mine) == number:
            suites[suite] = _mean(mine.values())
        else:
            rest |= mine
    whole_suites = all(suite in suites for suite in _LIBERO_MEAN)
    overall = _mean([suites[suite] for suite in _LIBERO_MEAN]) if whole_suites and not rest else None
    return {"overall_score": overall, "suite_scores": suites, "task_scores": _rounded(rest)}


def _simpler(found: list[Score]) -> dict[str, Any]:
    tasks = {_WIDOWX[task]: rate for task, rate in _by_task(found).items()}
    suites = {"widowx_vm": _mean(tasks.values())} if len(tasks) == len(_WIDOWX) else {}
    return {"overall_score": None, "suite_scores": suites, "task_scores": _rounded(tasks)}


def _by_task(found: list[Score]) -> Mapping[str, float]:
    """The success rate of each task, in per cent.

    Raises:
        ConfigError: A task was played under several settings, of which the leaderboard shows one.
    """
    rates: dict[str, float] = {}
    for score in found:
        for cell in score.cells:
            task = _task(cell)
            if task in rates:
                raise ConfigError(f"{cell.env}: is in several suites of these results, want one; choose one with --env")
            if cell.counted:
                rates[task] = 100 * (rate_of([cell], score.metric).rate or 0.0)
    return rates


def _task(cell: CellResults) -> str:
    """ "libero_spatial/3"; of LIBERO the suite and what the env says that it played, a number or a name."""
    said = cell.described.get("task")
    return said if env_suite(cell.env) == "libero" and isinstance(said, str) else str(env_task(cell.env))


def _mean(rates: Iterable[float]) -> float:
    values = list(rates)
    return round(sum(values) / len(values), 1)


def _rounded(rates: Mapping[str, float]) -> dict[str, float]:
    return {name: round(rate, 1) for name, rate in rates.items()}
