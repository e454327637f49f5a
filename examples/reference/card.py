"""Writes the model card of a reference policy: `python examples/reference/card.py CHECKPOINT
EVALUATION...`.

The card contains the data, the seeds, the commit, the success rates with their intervals, and the
limits.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import typer

from vlagents_ray.evaluate import Results
from vlagents_ray.evaluate.results.reader import CaseResults, rate_of
from vlagents_ray.policies.reference.checkpoint import Checkpoint, read_checkpoint
from vlagents_ray.success import SuccessCurve, read_curves

_TEXT = """---
license: apache-2.0
library_name: vlagents-ray
pipeline_tag: robotics
tags: [robotics, vision-language-action, flow-matching]
---

# The reference policy of vlagents-ray

This small vision-language-action policy shows how serving changes the success of a learned \
policy. It drives simulated
grippers only and is not for a real robot.

## Success

No demonstration was recorded with these seeds. The brackets contain 95 % intervals (Wilson). \
*Misled* is a control: the
instruction names other colours or another task, so that a policy that reads it must fail.

{rates}
{late}
`vlagents-ray verify NAME.bundle.zip` reproduces these results.

## Training

Scripted experts recorded the demonstrations (`examples/reference/demonstrations/`, and for the \
second training
`dagger.py demonstrate`). Failed episodes were left out. The first training used lossy H.264 \
video, the second lossless
images.

{trainings}

- {millions:.1f} million parameters in float32, `model.safetensors`; sizes, words and robots are \
in `config.json`.
- `make reference` repeats all steps. On the same kind of processor, a second run of the first \
training gave bit-identical weights.

## Limits

- It knows {known} words, and rejects others: {words}.
- Images have 64 px and come from the named cameras; Meta-World renders them without shadows.
- A chunk has eight actions, of which four were executed.
"""
MADE = "training.json"


def rates(results: Sequence[Results]) -> list[str]:
    """Return the rows of the table of rates, one for each task.

    `misled` is the control with wrong instructions.
    """
    cases = {(case.policy, case.env): case for one in results for case in one.cases}
    lines = ["| task | success, % | misled, % | seeds |", "|---|---|---|---|"]
    for (policy, env), case in cases.items():
        if policy == "reference":
            last = max(one.key.seed for one in case.counted)
            lines.append(
                f"| `{env}` | {_rate(case)} | {_rate(cases['misled', env])} | 0 to {last} |"
            )
    return lines


def late(curves: Sequence[SuccessCurve]) -> str:
    """Return the part about late answers; empty without curves."""
    if not curves:
        return ""
    lines = [
        "",
        "## Late answers",
        "",
        (
            "Episodes solved, %, by the delay of the answers in rows, which are ticks of the "
            "environment. The *tolerated delay* is the longest one up to which the lower 95 % "
            "bound is at least 0.95 of the success without delay."
        ),
        "",
        "| environment | mode | solved by delay | tolerated delay |",
        "|---|---|---|---|",
    ]
    for curve in curves:
        shares = [
            f"{rows}: {100 * one.solved / one.episodes:.1f}" for rows, one in curve.solved.items()
        ]
        settings = ", ".join(f"{name} {value}" for name, value in curve.settings.items())
        mode = f"`{curve.mode}`, {settings}"
        lines.append(f"| {curve.env} | {mode} | {'; '.join(shares)} | {curve.tolerated} |")
    return "\n".join([*lines, ""])


def trainings(trained: Mapping[str, Any], checkpoint: Checkpoint) -> list[str]:
    """Return a text for each training, the first one first.

    Args:
        trained: The description of the last training. Its `start` describes the training before.
        checkpoint: It names the cameras of each robot.
    """
    before = trained.get("start")
    texts = [] if before is None else trainings(before, checkpoint)
    summary = (
        "{steps} steps of {batch} frames out of {trained_frames}; seed {seed}; {threads} threads, "
        "{processor}, torch {torch}; code of commit {commit}"
    ).format(**trained)
    lines = [
        f"{len(texts) + 1}. {summary}",
        "",
        "   | robot | episodes | frames | cameras |",
        "   |---|---|---|---|",
    ]
    for name, recorded in trained["robots"].items():
        cameras = ", ".join(checkpoint.embodiments[name].cameras.values())
        lines.append(f"   | `{name}` | {recorded['episodes']} | {recorded['frames']} | {cameras} |")
    return [*texts, "\n".join(lines)]


def _rate(case: CaseResults) -> str:
    rate = rate_of([case], "success_once")
    low, high = rate.interval
    return f"{100 * rate.successes / rate.episodes:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def main(checkpoint: Path, evaluations: list[Path]) -> None:
    """Write README.md into the folder, and rates.json with the numbers of solved and of all
    episodes of each task.
    """
    results = [Results.load(folder) for folder in evaluations]
    stated, trained = read_checkpoint(checkpoint), json.loads((checkpoint / MADE).read_text())
    text = _TEXT.format(
        **trained,
        rates="\n".join(rates(results)),
        late=late(read_curves(checkpoint)),
        trainings="\n\n".join(trainings(trained, stated)),
        millions=trained["parameters"] / 1e6,
        known=len(stated.words),
        words=", ".join(stated.words),
    )
    (checkpoint / "README.md").write_text(text, encoding="utf-8")
    solved: dict[str, dict[str, tuple[int, int]]] = {}
    for case in (case for one in results for case in one.cases if case.policy == "reference"):
        rate = rate_of([case], "success_once")
        solved.setdefault(case.env.partition("/")[0], {})[case.env] = rate.successes, rate.episodes
    (checkpoint / "rates.json").write_text(json.dumps(solved) + "\n")


if __name__ == "__main__":
    typer.run(main)
