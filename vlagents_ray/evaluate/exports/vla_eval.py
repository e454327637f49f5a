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
# LIBERO-PRO's suites of ten tasks each by their names on the leaderboard; the overall score is the mean of the twenty
# cells of four suites and five kinds, of which `ori` is LIBERO itself (its leaderboard's page).
_PRO_SUITES = {"libero_spatial": "spatial", "libero_object": "object", "libero_goal": "goal", "libero_10": "long"}
_PRO_KINDS = {"swap": "pos", "lan": "sem", "task": "task", "object": "obj", "env": "env"}
_PRO = {f"{suite}_{kind}": f"{a}_{b}" for suite, a in _PRO_SUITES.items() for kind, b in _PRO_KINDS.items()}
_PRO_MEAN = [f"{suite}_{kind}" for suite in _PRO_SUITES.values() for kind in ("ori", "obj", "pos", "sem", "task")]


class VlaEvalSettings(BaseModel):
    """Fields of a leaderboard entry that results do not have."""

    model_config = ConfigDict(extra="forbid")

    curated_by: str = Field(pattern=r"^@[\w-]+$", examples=["@HANDLE"])  # your handle on GitHub
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
    LIBERO-PRO's is given if its suites of positions, instructions, goals and objects and LIBERO's own are all there.

    Args:
        results: Of one policy id, in LIBERO, LIBERO-PRO or SIMPLER.
        path: The file.
        settings: The fields of `VlaEvalSettings`.

    Returns:
        The number of episodes that the entries count.

    Raises:
        ConfigError: There are several policy ids, or an env that the leaderboard has no score for.
    """
    given = VlaEvalSettings.model_validate(settings)
    found = scores(results)
    by_benchmark: dict[str, list[Score]] = {}
    for score in found:
        by_benchmark.setdefault(_benchmark(score), []).append(score)
    if "libero_pro" in by_benchmark:  # whose original suites are LIBERO's
        by_benchmark["libero_pro"] += [one for one in by_benchmark.get("libero", []) if _suite(one) in _PRO_SUITES]
    entries = [_entry(name, theirs, given) for name, theirs in sorted(by_benchmark.items())]
    document = {"last_updated": max(str(one["date_added"]) for one in entries), "results": entries}
    with whole(path) as part:
        part.write_text(json.dumps(document, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    return sum(score.rate.episodes for score in found)


def _benchmark(score: Score) -> str:
    """The leaderboard's name of the benchmark."""
    suite = env_suite(score.cells[0].env)
    found = {"simpler": "simpler_env"}.get(suite)
    if suite == "libero":
        found = "libero" if _suite(score) in _LIBERO else "libero_pro" if _suite(score) in _PRO else None
        counted = [cell for cell in score.cells if cell.counted]
        if varied := [cell.env for cell in counted if not _task(cell).rpartition("/")[2].isdecimal()]:
            raise ConfigError(
                f"{varied[0]}: varies a task of {_suite(score)}; vla-eval's leaderboard scores LIBERO-Plus by kinds of "
                f"changes, of which hf-libero cannot play all; choose with --env, or use another format"
            )
    if found is None:
        raise ConfigError(
            f"{score.name}: vla-eval's leaderboard has no such benchmark, want LIBERO, LIBERO-PRO or SIMPLER; choose "
            f"with --env, or use another format"
        )
    return found


def _entry(benchmark: str, found: list[Score], given: VlaEvalSettings) -> dict[str, Any]:
    name = found[0].results.contenders[0]
    parts = {"libero": _libero, "libero_pro": _libero_pro, "simpler_env": _simpler}[benchmark](found)
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


def _libero_pro(found: list[Score]) -> dict[str, Any]:
    """The suites, as the leaderboard has no scores of tasks here."""
    own = _libero([score for score in found if _suite(score) in _PRO_SUITES])["suite_scores"]
    suites: dict[str, float] = {f"{_PRO_SUITES[suite]}_ori": rate for suite, rate in own.items()}
    tasks = _by_task([score for score in found if _suite(score) in _PRO])
    for suite in dict.fromkeys(task.partition("/")[0] for task in tasks):
        rates = [rate for task, rate in tasks.items() if task.partition("/")[0] == suite]
        if len(rates) != _LIBERO["libero_10"]:
            raise ConfigError(
                f"libero/{suite}: got results of {len(rates)} tasks, want all ten, as the leaderboard has scores of "
                f"LIBERO-PRO's suites alone; play the others, or choose with --env"
            )
        suites[_PRO[suite]] = _mean(rates)
    overall = _mean([suites[name] for name in _PRO_MEAN]) if suites.keys() >= set(_PRO_MEAN) else None
    return {"overall_score": overall, "suite_scores": suites, "task_scores": {}}


def _simpler(found: list[Score]) -> dict[str, Any]:
    tasks = {_WIDOWX[task]: rate for task, rate in _by_task(found).items()}
    suites = {"widowx_vm": _mean(tasks.values())} if len(tasks) == len(_WIDOWX) else {}
    return {"overall_score": None, "suite_scores": suites, "task_scores": _rounded(tasks)}


def _by_task(found: list[Score]) -> Mapping[str, float]:
    """The success rate of each task, in per cent."""
    rates: dict[str, float] = {}
    for score in found:
        for cell in score.cells:
            task = _task(cell)
            if task in rates:
                raise ConfigError(f"{cell.env}: is in several suites of these results, want one; choose one with --env")
            if cell.counted:
                rates[task] = 100 * (rate_of([cell], score.metric).rate or 0.0)
    return rates


def _suite(score: Score) -> str:
    return _task(score.cells[0]).partition("/")[0]


def _task(cell: CellResults) -> str:
    """ "libero_spatial/3"; of LIBERO the suite and what the env says that it played, a number or a name."""
    said = cell.described.get("task")
    return said if env_suite(cell.env) == "libero" and isinstance(said, str) else str(env_task(cell.env))


def _mean(rates: Iterable[float]) -> float:
    values = list(rates)
    return round(sum(values) / len(values), 1)


def _rounded(rates: Mapping[str, float]) -> dict[str, float]:
    return {name: round(rate, 1) for name, rate in rates.items()}
