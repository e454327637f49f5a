"""Success rates to publish, with episodes, interval, protocol, weights and code.

`to_hub` writes them for a model repository of the Hugging Face Hub, in the format of
https://huggingface.co/docs/hub/eval-results, which `huggingface_hub` 2.4 reads.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, field_validator

from vlagents_ray.envs.base import Metric
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.storage import whole_folder
from vlagents_ray.evaluate.results.reader import CellResults, Results, have_common_rate, rate_of
from vlagents_ray.evaluate.results.statistics import Rate
from vlagents_ray.evaluate.results.summary import pushed_of, stated
from vlagents_ray.naming import distinct, plain

_MOST_NOTED = 5  # deviations in a note


@dataclass(frozen=True, slots=True)
class Score:
    """The success rate of one policy id in one benchmark, or in a part of it."""

    results: Results
    name: str  # "libero/libero_spatial", "tabletop"; with the suite or the task if needed
    cells: tuple[CellResults, ...]  # with a common rate

    @property
    def metric(self) -> Metric:
        """The success that the benchmark's protocol counts: after some step, or after the last."""
        at_end = any(_protocol(cell).get("metric") == "success_at_end" for cell in self.cells)
        return "success_at_end" if at_end else "success_once"

    @property
    def rate(self) -> Rate:
        return rate_of(self.cells, self.metric)

    @property
    def date(self) -> datetime:
        """The time at which the last episode was recorded, in UTC."""
        last = max(one.finished for cell in self.cells for one in cell.episodes if one.counts)
        return datetime.fromtimestamp(int(last), timezone.utc)

    @property
    def deviations(self) -> list[str]:
        """The differences from the protocol or the plan, a phrase each."""
        found: dict[str, None] = {}
        for cell in self.cells:
            found |= {str(one): None for one in _protocol(cell).get("deviations") or []}
            stated = {
                "real time: the environment does not wait for the policy": cell.settings.get("clock") is not None,
                "the policy got JPEG images": cell.settings.get("codec") == "jpeg",
                f"{cell.env}: stopped early, after {cell.stopped_at} of {cell.planned} episodes": cell.stopped_at,
                f"{cell.env}: {cell.missing} of {cell.planned} planned episodes have no result": cell.missing,
            }
            found |= {text: None for text, holds in stated.items() if holds}
        return list(found)

    @property
    def note(self) -> str:
        """Everything that qualifies the rate, in one line of text."""
        rate, counted = self.rate, [one for cell in self.cells for one in cell.counted]
        low, high = (f"{100 * bound:.1f}" for bound in rate.interval)
        kind = "95 % interval (Wilson)"
        if rate.error_rate is not None:
            kind = f"{100 * (1 - rate.error_rate):g} % interval (confidence sequence)"
        seeds = sorted(one.key.seed for one in counted)
        odd = self.deviations
        more = f"; and {len(odd) - _MOST_NOTED} more" if len(odd) > _MOST_NOTED else ""
        protocols = [_protocol(cell) for cell in self.cells]
        named = _distinct(one.get("name") for one in protocols)
        protocol = ", ".join(named) or ("the environment's" if any(protocols) else "none stated")
        weights = _distinct(stated(cell, "weights") for cell in self.cells) + _distinct(map(pushed_of, self.cells))
        weights = weights or _distinct(stated(cell, "checkpoint") for cell in self.cells) or ["no digest reported"]
        errors = sum(one.status == "policy_error" for one in counted)
        when = "some step" if self.metric == "success_once" else "the last step"
        return (
            f"success rate in %, solved after {when}; {rate.successes} of {rate.episodes} episodes, {kind} {low} to "
            f"{high}; ended by an error of the policy: {errors}; seeds {seeds[0]} to {seeds[-1]}; "
            f"protocol: {protocol}; deviations: {'; '.join(odd[:_MOST_NOTED]) or 'none'}{more}; "
            f"weights: {', '.join(weights)}; "
            f"code: {', '.join(_distinct(_code(run.versions) for run in self.results.runs))}"
        )


def scores(results: Results) -> list[Score]:
    """Return the scores of the only policy id in `results`, by benchmark; suites with other options are separate."""
    if len(results.contenders) != 1:
        raise ConfigError(f"got the policies {results.contenders}, want one: name it with --policy NAME, or NAME@STEP")
    groups: dict[tuple[str, str], list[CellResults]] = {}
    for cell in results.cells:
        groups.setdefault((cell.suite, benchmark_of(cell.env)), []).append(cell)
    # A task without episodes stays with its benchmark, whose score lists it among the deviations.
    groups = {name: cells for name, cells in groups.items() if any(cell.counted for cell in cells)}
    if not groups:
        raise ConfigError(f"{results.out}: has no finished episode, want results that a rate can be made of")
    names = [benchmark for _, benchmark in groups]
    found: list[Score] = []
    for (suite, benchmark), cells in groups.items():
        name = benchmark if names.count(benchmark) == 1 else f"{suite} {benchmark}".strip()
        if have_common_rate(cells):
            found.append(Score(results, name, tuple(cells)))
        else:  # they stopped after different numbers of episodes, or some were in real time
            found += [Score(results, cell.task, (cell,)) for cell in cells if cell.counted]
    return found


def benchmark_of(env: str) -> str:
    """Return the benchmark of an env: "libero/libero_spatial" of "libero/libero_spatial/3"."""
    return env if ":" in env else env.rpartition("/")[0] or env


def _protocol(cell: CellResults) -> dict[str, Any]:
    stated = cell.described.get("protocol")
    return dict(stated) if isinstance(stated, dict) else {}


def _distinct(values: Iterable[Any]) -> list[str]:
    return list(dict.fromkeys(str(value) for value in values if value))


def _code(versions: dict[str, Any]) -> str:
    state = (versions.get("code") or {}).get("vlagents_ray") or {}
    commit = f" at commit {state['commit']}" if state.get("commit") else ""
    changed = f" with changes (SHA-256 {state['diff_sha256']})" if state.get("diff_sha256") else ""
    return f"vlagents-ray {versions.get('vlagents-ray')}{commit}{changed}"


_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")


class HubSettings(BaseModel):
    """Settings of the export that results do not have."""

    model_config = ConfigDict(extra="forbid")

    dataset: str = Field(examples=["OWNER/NAME"])  # the benchmark's on the Hub, with its leaderboard
    task_id: str | None = None  # of that benchmark's eval.yaml; None: the name of the score, without its simulator
    source_url: str | None = None  # of the bundle, or of a paper

    @field_validator("dataset")
    @classmethod
    def _is_id(cls, dataset: str) -> str:
        if not _ID.fullmatch(dataset):
            raise ValueError(f"got {dataset!r}, want the id of a dataset on the Hub, OWNER/NAME")
        return dataset


def to_hub(results: Results, path: Path, **settings: Any) -> int:
    """Write the new folder `path`, whose `.eval_results/DATASET.yaml` goes into the model's repository.

    It has an entry for each score. Its `value` is in per cent, and its `notes` have the episodes, the interval, the
    protocol, the deviations, the digest of the weights and the commit in one line.

    Args:
        results: The results of one policy id.
        path: A folder that does not exist, or is empty.
        settings: The fields of `HubSettings`.

    Returns:
        The number of episodes that the scores count.

    Raises:
        ConfigError: There are several policy ids, several scores for one `task_id`, or `path` has files.
    """
    given = HubSettings.model_validate(settings)
    found = scores(results)
    if given.task_id is not None and len(found) > 1:
        raise ConfigError(
            f"task_id: got {given.task_id!r} for the scores {[one.name for one in found]}, want one; choose with --env"
        )
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise ConfigError(f"{path}: is there already; want a new folder")
    # The names without their simulator, "libero_spatial" of "libero/libero_spatial", if they stay distinct.
    names = [one.name for one in found]
    short = [plain(name.rpartition("/")[2]) for name in names]
    ids = dict(zip(names, short, strict=True)) if len(set(short)) == len(short) else distinct(names)
    entries: list[dict[str, Any]] = [
        {
            "dataset": {"id": given.dataset, "task_id": given.task_id or ids[one.name]},
            "value": round(100 * (one.rate.rate or 0.0), 2),
            "date": one.date.isoformat().replace("+00:00", "Z"),
            "notes": one.note,
        }
        for one in found
    ]
    if given.source_url is not None:
        entries = [one | {"source": {"url": given.source_url, "name": "results by vlagents-ray"}} for one in entries]
    with whole_folder(path) as folder:
        file = folder / ".eval_results" / f"{plain(given.dataset)}.yaml"
        file.parent.mkdir()
        file.write_text(yaml.safe_dump(entries, sort_keys=False, allow_unicode=True, width=100), encoding="utf-8")
    return sum(one.rate.episodes for one in found)
