"""Success rates as others quote them: with the episodes, the interval, the protocol, the weights and the code.

`to_hub` writes them for a model repository of the Hugging Face Hub: `.eval_results/*.yaml`, and a model card's
`model-index`. The formats are those of the Hub's documentation, https://huggingface.co/docs/hub/eval-results and
https://github.com/huggingface/hub-docs/blob/main/modelcard.md; `huggingface_hub` 2.4 reads both.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, field_validator

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.storage import whole_folder
from vlagents_ray.evaluate.results.reader import CellResults, Results, have_common_rate, rate_of
from vlagents_ray.evaluate.results.statistics import Rate
from vlagents_ray.evaluate.results.summary import checkpoint_of, pushed_of, weights_of
from vlagents_ray.naming import distinct, plain

Metric = Literal["success_once", "success_at_end"]
_AT_END = "at the end"  # SIMPLER's protocol: the last state decides
_MOST_NOTED = 5  # deviations in a note; `Score.facts` has all


@dataclass(frozen=True, slots=True)
class Score:
    """The success rate of one policy id in one benchmark, or in a part of it."""

    results: Results
    name: str  # "libero/libero_spatial", "tabletop"; after the name of a suite, or with the task, where that is needed
    cells: tuple[CellResults, ...]  # that have a common rate

    @property
    def metric(self) -> Metric:
        """The success that the benchmark's protocol counts: after some step, unless it says after the last."""
        return (
            "success_at_end" if any(_protocol(one).get("success") == _AT_END for one in self.cells) else "success_once"
        )

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
        found = [text for cell in self.cells for text in _deviations(cell)]
        return list(dict.fromkeys(found))

    @property
    def facts(self) -> dict[str, Any]:
        """All that pools or doubts the rate, as plain JSON values."""
        low, high = self.rate.interval
        kind = "Wilson" if self.rate.error_rate is None else "confidence sequence"
        level = 0.95 if self.rate.error_rate is None else 1 - self.rate.error_rate
        seeds = sorted({one.key.seed for cell in self.cells for one in cell.counted})
        return {
            "episodes": self.rate.episodes,
            "successes": self.rate.successes,
            "interval": {"low": low, "high": high, "level": level, "kind": kind},
            "policy_errors": sum(one.status == "policy_error" for cell in self.cells for one in cell.counted),
            "seeds": [seeds[0], seeds[-1]],
            "tasks": {cell.env: rate_of([cell], self.metric).to_json() for cell in self.cells},
            "protocols": _distinct([_protocol(cell) for cell in self.cells]),
            "deviations": self.deviations,
            "settings": sorted(cell.cell for cell in self.cells),
            "checkpoints": _distinct([checkpoint_of(cell) for cell in self.cells]),
            "weights": _distinct([weights_of(cell) for cell in self.cells]),
            "pushed_weights": _distinct([pushed_of(cell) for cell in self.cells]),
            "policies": _distinct([self.results.policies.get(cell.policy, {}).get("policy") for cell in self.cells]),
            "code": _distinct([_code(run.versions) for run in self.results.runs]),
        }

    @property
    def note(self) -> str:
        """The facts in one line of text."""
        facts, low_high = self.facts, [f"{100 * bound:.1f}" for bound in self.rate.interval]
        kind, level = facts["interval"]["kind"], facts["interval"]["level"]
        odd = facts["deviations"]
        more = f"; and {len(odd) - _MOST_NOTED} more" if len(odd) > _MOST_NOTED else ""
        names = [str(one["name"]) for one in facts["protocols"] if "name" in one]
        stated = ", ".join(dict.fromkeys(names)) or ("the environment's" if facts["protocols"] else "none stated")
        weights = ", ".join(facts["weights"] or facts["checkpoints"]) or "no digest reported"
        return (
            f"success rate in %, {_WHEN[self.metric]}; {facts['successes']} of {facts['episodes']} episodes, "
            f"{100 * level:g} % interval ({kind}) {low_high[0]} to {low_high[1]}; "
            f"seeds {facts['seeds'][0]} to {facts['seeds'][1]}; protocol: {stated}; "
            f"deviations: {'; '.join(odd[:_MOST_NOTED]) or 'none'}{more}; weights: {weights}; "
            f"code: {', '.join(_code_text(one) for one in facts['code'])}"
        )


_WHEN = {"success_once": "solved after some step", "success_at_end": "solved after the last step"}


def scores(results: Results) -> list[Score]:
    """The scores of the only policy id in `results`, by benchmark, those of suites with other options apart."""
    if len(results.contenders) != 1:
        raise ConfigError(f"got the policies {results.contenders}, want one: name it with --policy NAME, or NAME@STEP")
    groups: dict[tuple[str, str], list[CellResults]] = {}
    for cell in results.cells:
        groups.setdefault((cell.suite, benchmark_of(cell.env)), []).append(cell)
    # A task all of whose episodes were lost stays with its benchmark, whose score has it among the deviations.
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
    """The benchmark that an env's name belongs to: "libero/libero_spatial" of "libero/libero_spatial/3"."""
    return env if ":" in env else env.rpartition("/")[0] or env


def _protocol(cell: CellResults) -> dict[str, Any]:
    stated = cell.described.get("protocol")
    return dict(stated) if isinstance(stated, dict) else {}


def _deviations(cell: CellResults) -> list[str]:
    found = [str(one) for one in _protocol(cell).get("deviations") or []]
    if cell.settings.get("clock") is not None:
        found.append("real time: the environment does not wait for the policy")
    if cell.settings.get("codec") == "jpeg":
        found.append("the policy got JPEG images")
    if cell.stopped_at is not None:
        found.append(f"{cell.env}: stopped early, after {cell.stopped_at} of {cell.planned} episodes")
    if cell.missing:
        found.append(f"{cell.env}: {cell.missing} of {cell.planned} planned episodes have no result")
    return found


def _distinct(values: Sequence[Any]) -> list[Any]:
    found: list[Any] = []
    for value in values:
        if value and value not in found:
            found.append(value)
    return found


def _code(versions: dict[str, Any]) -> dict[str, Any]:
    state = (versions.get("code") or {}).get("vlagents_ray") or {}
    return {"vlagents-ray": versions.get("vlagents-ray")} | {
        name: state[name] for name in ("commit", "diff_sha256") if state.get(name)
    }


def _code_text(code: dict[str, Any]) -> str:
    commit = f" at commit {code['commit']}" if "commit" in code else ""
    changed = f" with changes (SHA-256 {code['diff_sha256']})" if "diff_sha256" in code else ""
    return f"vlagents-ray {code.get('vlagents-ray')}{commit}{changed}"


_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
_NAMES = {"success_once": "success rate (after some step)", "success_at_end": "success rate (after the last step)"}


class HubSettings(BaseModel):
    """Settings of the export that results do not have."""

    model_config = ConfigDict(extra="forbid")

    dataset: str = Field(
        examples=["OWNER/NAME"]
    )  # the benchmark's dataset on the Hub, OWNER/NAME, where its leaderboard is
    task_id: str | None = None  # of that benchmark's eval.yaml; None: the name of the score, without its simulator
    model: str | None = None  # name in the model-index; None: the policy's in the evaluation
    source_url: str | None = None  # of the bundle, or of a paper

    @field_validator("dataset")
    @classmethod
    def _is_id(cls, dataset: str) -> str:
        if not _ID.fullmatch(dataset):
            raise ValueError(f"got {dataset!r}, want the id of a dataset on the Hub, OWNER/NAME")
        return dataset


def to_hub(results: Results, path: Path, **settings: Any) -> int:
    """Write the new folder `path`, whose files go into the model's repository.

    `.eval_results/DATASET.yaml` has an entry for each score, whose `value` is in per cent and whose `notes` say the
    episodes, the interval, the protocol, the deviations, the digest of the weights and the commit in one line.
    `README.md` is a model card with a `model-index`, whose metrics have all of that as `args`; merge its head into the
    card that the repository has.

    Args:
        results: Of one policy id.
        path: A folder that does not exist, or is empty.
        settings: The fields of `HubSettings`.

    Returns:
        The number of episodes that the scores count.

    Raises:
        ConfigError: There are several policy ids, `task_id` stands for several scores, or `path` has files.
    """
    given = HubSettings.model_validate(settings)
    found = scores(results)
    if given.task_id is not None and len(found) > 1:
        raise ConfigError(
            f"task_id: got {given.task_id!r} for the scores {[one.name for one in found]}, want one; choose with --env"
        )
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise ConfigError(f"{path}: is there already; want a new folder")
    ids = _task_ids([one.name for one in found])
    tasks = [(one, given.task_id or ids[one.name]) for one in found]
    card = {"tags": ["robotics"], "model-index": _index(tasks, given)}
    with whole_folder(path) as folder:
        entries = folder / ".eval_results" / f"{plain(given.dataset)}.yaml"
        entries.parent.mkdir()
        entries.write_text(_yaml([_entry(one, task, given) for one, task in tasks]), encoding="utf-8")
        (folder / "README.md").write_text(f"---\n{_yaml(card)}---\n\n{_table(found)}", encoding="utf-8")
    return sum(one.rate.episodes for one in found)


def _entry(score: Score, task: str, given: HubSettings) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "dataset": {"id": given.dataset, "task_id": task},
        "value": _percent(score.rate.rate),
        "date": score.date.isoformat().replace("+00:00", "Z"),
        "notes": score.note,
    }
    if given.source_url is not None:
        entry["source"] = {"url": given.source_url, "name": "results by vlagents-ray"}
    return entry


def _index(found: list[tuple[Score, str]], given: HubSettings) -> list[dict[str, Any]]:
    source = (
        {} if given.source_url is None else {"source": {"url": given.source_url, "name": "results by vlagents-ray"}}
    )
    return [
        {
            "name": given.model or found[0][0].results.contenders[0],
            "results": [
                {
                    "task": {"type": "robotics", "name": "Robotics"},
                    "dataset": {"name": one.name, "type": given.dataset, "config": task},
                    "metrics": _metrics(one),
                    **source,
                }
                for one, task in found
            ],
        }
    ]


def _metrics(score: Score) -> list[dict[str, Any]]:
    """The success that the protocol counts, with all facts; then the other one, with its interval."""
    other: Metric = "success_at_end" if score.metric == "success_once" else "success_once"
    return [
        {"type": score.metric, "name": _NAMES[score.metric], "value": _percent(score.rate.rate), "args": score.facts},
        {
            "type": other,
            "name": _NAMES[other],
            "value": _percent(rate_of(score.cells, other).rate),
            "args": rate_of(score.cells, other).to_json(),
        },
    ]


def _task_ids(names: list[str]) -> dict[str, str]:
    """The names without their simulator, "libero_spatial" of "libero/libero_spatial", where that tells them apart."""
    short = [plain(name.rpartition("/")[2]) for name in names]
    return dict(zip(names, short, strict=True)) if len(set(short)) == len(short) else distinct(names)


def _percent(rate: float | None) -> float:
    return round(100 * (rate or 0.0), 2)


def _table(found: list[Score]) -> str:
    """The scores as Markdown, in which names are code: they are text of others."""
    lines = ["# Evaluation", "", "| benchmark | success | episodes | interval |", "| --- | --- | --- | --- |"]
    for one in found:
        low, high = (f"{100 * bound:.1f}" for bound in one.rate.interval)
        success = f"{_percent(one.rate.rate):g} %"
        lines.append(f"| {_as_code(one.name)} | {success} | {one.rate.episodes} | {low} to {high} % |")
    return "\n".join([*lines, "", *(f"- {_as_code(one.name)}: {_as_code(one.note)}" for one in found)]) + "\n"


def _as_code(text: str) -> str:
    plain_text = " ".join(text.split()).replace("`", "'").replace("|", "/")
    return f"`{plain_text}`"


def _yaml(value: Any) -> str:
    return str(yaml.safe_dump(value, sort_keys=False, allow_unicode=True, width=100))
