"""The commands that read results: `vlagents-ray report`, `export` and `replay`."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from vlagents_ray.cli.console import errors, fresh, out, print_json
from vlagents_ray.cli.options import (
    Address,
    AsJson,
    ConfigDir,
    Live,
    LiveAt,
    Set,
    changed_settings,
    find_policy,
)
from vlagents_ray.errors import ConfigError
from vlagents_ray.overrides import parse_overrides, parse_settings
from vlagents_ray.registry import entries, registered_function
from vlagents_ray.settings import wrong_settings

Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of results.")]


def report_command(
    folders: Annotated[list[Path], typer.Argument(metavar="FOLDER...", help="Folders of results.")],
    path: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="File of the report; default: report.html in FOLDER; with several folders: "
            "./report.html.",
        ),
    ] = None,
    inline: Annotated[
        bool,
        typer.Option("--inline", help="Embed the videos in the page, up to a maximum size."),
    ] = False,
    accept_changes: Annotated[
        bool,
        typer.Option(
            "--accept-changes",
            help="Compare even if files, weights or environments differ. The report lists the "
            "differences.",
        ),
    ] = False,
    as_json: AsJson = False,
    live: Live = False,
    live_at: LiveAt = None,
) -> None:
    """Write the report: success with intervals, comparisons, latency, failures, and settings.

    With --live, show the results in FOLDER while another process adds to them, until Ctrl-C. In
    this case no report is written.
    """
    from vlagents_ray.evaluate import Results
    from vlagents_ray.evaluate.artifacts.storage import require_folder_of
    from vlagents_ray.evaluate.report.page import FILE, write_report
    from vlagents_ray.evaluate.report.success import families_json
    from vlagents_ray.evaluate.results.combination import combined
    from vlagents_ray.evaluate.results.summary import summarize

    with errors():
        if live or live_at:
            from vlagents_ray.cli.evaluation import follow, live_address

            if len(folders) != 1 or path is not None or as_json:
                raise ConfigError(
                    "--live: expected one FOLDER, no --out and no --json, got more arguments; "
                    "leave them out, as --live shows one folder and writes nothing"
                )
            follow(folders[0], live_address(live_at))
            return

        results = combined([Results.load(folder) for folder in folders])
        if as_json:
            summary = summarize(results)
            compared = families_json(summary, accept_changes=accept_changes)
            print_json(summary.to_json() | {"comparisons": compared})
            return

        if path is None:
            path = folders[0] / FILE if len(folders) == 1 else Path(FILE)
        require_folder_of(path)
        written = write_report(results, path, inline=inline, accept_changes=accept_changes)
        out.print(f"report: {written}")


def _described_formats() -> Iterator[str]:
    """Yield the name of each export format with its description."""
    for name, entry in entries("exports").items():
        yield f"{name}: {entry.about}"


def export_command(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Folder of results."),
    ],
    path: Annotated[
        Path,
        typer.Option("--out", metavar="PATH", help="New file or folder, depending on the format."),
    ],
    to: Annotated[
        str,
        typer.Option(metavar="FORMAT", help="The format. " + "; ".join(_described_formats()) + "."),
    ],
    policy: Annotated[
        str | None,
        typer.Option(
            metavar="POLICY",
            help="Export only the episodes of this policy: NAME, or NAME@STEP of one checkpoint.",
        ),
    ] = None,
    env: Annotated[
        str | None,
        typer.Option(metavar="ENV", help="Export only the episodes in this environment."),
    ] = None,
    settings: Annotated[
        list[str],
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="A setting of the format, such as successes=true. May be repeated.",
        ),
    ] = [],  # noqa: B006 - typer reads the default
) -> None:
    """Write the episodes of an evaluation in a format for other programs, such as CSV or a
    LeRobotDataset.
    """
    from vlagents_ray.disk import storing
    from vlagents_ray.evaluate import Results

    with errors():
        _require_no_dataset(folder)
        export = registered_function("exports", to)
        results = Results.load(folder).only(policy, env)
        parsed = settings_of_export(to, export, settings)
        with storing(path.parent, "then export again"):
            number = export(results, path, **parsed)
    out.print(f"wrote {number} episodes to {path}")


def settings_of_export(
    name: str, export: Callable[..., int], texts: Sequence[str]
) -> dict[str, Any]:
    """Parse the settings of a format, which are the keyword-only parameters of its function.

    Args:
        name: The name of the format.
        export: The function of the format.
        texts: The settings as KEY=VALUE.

    Returns:
        The settings that are set, by name.

    Raises:
        ConfigError: A setting is unknown, or its value has another type than the parameter.
    """
    from pydantic import ConfigDict, ValidationError, create_model

    fields: dict[str, Any] = {}
    for parameter in inspect.signature(export, eval_str=True).parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY:
            default = ... if parameter.default is parameter.empty else parameter.default
            fields[parameter.name] = (parameter.annotation, default)
    model = create_model(name, __config__=ConfigDict(extra="forbid"), **fields)
    try:
        parsed = model.model_validate(parse_settings(texts, "--set"))
    except ValidationError as error:
        raise ConfigError(
            f"--set, for --to {name}: {wrong_settings(error, model, '--set')}"
        ) from error
    return {field: getattr(parsed, field) for field in parsed.model_fields_set}


def _require_no_dataset(folder: Path) -> None:
    """Raise `ConfigError` if a folder is or contains LeRobotDatasets, which only `open-loop`
    reads.
    """
    if any(folder.glob("meta/info.json")) or any(folder.glob("*/meta/info.json")):
        raise ConfigError(
            f"{folder}: expected results of an evaluation, got a LeRobotDataset; run "
            f"`vlagents-ray open-loop {folder} --policy NAME` to compare a policy with it"
        )


def replay_command(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of results.")],
    episode: Annotated[
        str | None,
        typer.Argument(
            metavar="[EPISODE]",
            help="The episode: its key, or ENV#NUMBER, such as 'tabletop#3'.",
            show_default=False,
        ),
    ] = None,
    policy: Annotated[
        str | None,
        typer.Option(
            metavar="POLICY",
            help="Another policy: a name, a deployment file, or a URL; default: the policy of the "
            "evaluation.",
        ),
    ] = None,
    settings: Set = [],  # noqa: B006
    config_dir: ConfigDir = None,
    out_dir: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FOLDER", help="Folder of the replay; default: a new one in FOLDER."
        ),
    ] = None,
    address: Address = None,
) -> None:
    """Run an episode of an evaluation again, and compare the actions and the outcome.

    Exit status: 0 if both are the same, 1 if they differ.
    """
    with errors():
        from vlagents_ray.cli.evaluation import play_one
        from vlagents_ray.evaluate import Results
        from vlagents_ray.evaluate.replay import actions_difference, compare, find

        _require_no_dataset(folder)
        recorded = find(Results.load(folder), episode)
        other_policy: dict[str, Any] | None = None
        if policy is not None:
            source = find_policy(policy, config_dir)
            changed = changed_settings(source, parse_overrides(settings, "--set"))
            other_policy = {"source": source, "url": None, "config": changed, "checkpoint": None}
        elif settings:
            raise ConfigError(
                "--set: expected --policy with it, got none; name the policy that has the setting"
            )
        replay_folder = out_dir or fresh(folder / "replays" / "replay")
        config = recorded.config(replay_folder, policy=other_policy)
        rows = recorded.rows if policy is None else None
        summary = play_one(config, address, recorded.number_and_seed, rows=rows)

        differences = compare(recorded, summary.results)
        rounding = actions_difference(recorded, summary.results)
        steps = recorded.episode.result.steps
        same = f"the same: {steps} actions byte for byte, and their outcomes"
        if rounding is not None:
            same = (
                f"the same up to rounding: {steps} actions, and their outcomes; the first "
                f"difference is {rounding.at_first:.2g} at step {rounding.step}, as in batches of "
                f"another size, the largest {rounding.largest:.2g}"
            )
        for line in [*(differences or [same]), f"replay: {replay_folder}"]:
            out.print(line)
    raise typer.Exit(bool(differences))
