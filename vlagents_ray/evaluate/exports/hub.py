"""Results for a model repository of the Hugging Face Hub: `.eval_results/*.yaml`, and a model card's `model-index`.

The formats are those of the Hub's documentation, https://huggingface.co/docs/hub/eval-results and
https://github.com/huggingface/hub-docs/blob/main/modelcard.md; `huggingface_hub` 2.4 reads both.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, field_validator

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.storage import whole_folder
from vlagents_ray.evaluate.exports.scores import Metric, Score, scores
from vlagents_ray.evaluate.results.reader import Results, rate_of
from vlagents_ray.naming import distinct, plain

_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
_NAMES = {"success_once": "success rate (after some step)", "success_at_end": "success rate (after the last step)"}


class HubSettings(BaseModel):
    """What the results do not know of the Hub."""

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
        lines.append(f"| {_code(one.name)} | {success} | {one.rate.episodes} | {low} to {high} % |")
    return "\n".join([*lines, "", *(f"- {_code(one.name)}: {_code(one.note)}" for one in found)]) + "\n"


def _code(text: str) -> str:
    plain_text = " ".join(text.split()).replace("`", "'").replace("|", "/")
    return f"`{plain_text}`"


def _yaml(value: Any) -> str:
    return str(yaml.safe_dump(value, sort_keys=False, allow_unicode=True, width=100))
