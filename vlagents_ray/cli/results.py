"""The commands that read results: `vlagents-ray report`, `export`, `merge`, `bundle`, `verify` and `replay`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from vlagents_ray.bounds import MOST_EPISODES
from vlagents_ray.cli.console import errors, fresh, out, print_json, require_folder_of, table
from vlagents_ray.cli.options import Address, AsJson, Live, LiveAt, finite, parse_list
from vlagents_ray.errors import ConfigError

_TABLES = ("json", "csv", "parquet")  # formats of one file
Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of results.")]


def report_command(
    folders: Annotated[list[Path], typer.Argument(metavar="FOLDER...", help="Folders of results.")],
    path: Annotated[
        Path | None, typer.Option("--out", help="Default: report.html in FOLDER; of several, here.")
    ] = None,
    inline: Annotated[bool, typer.Option("--inline", help="With videos in the page, as far as they fit.")] = False,
    accept_changes: Annotated[
        bool,
        typer.Option("--accept-changes", help="Compare although files, weights or envs differ; the report says so."),
    ] = False,
    as_json: AsJson = False,
    live: Live = False,
    live_at: LiveAt = None,
) -> None:
    """Write the report: success with intervals, comparisons, latency, failures, and settings.

    With --live it shows the results in FOLDER as another process adds to them, until Ctrl-C, and writes no report.
    """
    from vlagents_ray.evaluate import Results
    from vlagents_ray.evaluate.merge import combined
    from vlagents_ray.evaluate.report.page import FILE, write_report
    from vlagents_ray.evaluate.report.success import families_json
    from vlagents_ray.evaluate.results.summary import summarize

    with errors():
        if live or live_at:
            from vlagents_ray.cli.evaluation import follow, live_address

            if len(folders) != 1 or path is not None or as_json:
                raise ConfigError(
                    "--live shows one folder, and writes nothing: want one FOLDER, no --out and no --json"
                )
            follow(folders[0], live_address(live_at))
            return
        results = combined([Results.load(folder) for folder in folders])
        if as_json:
            summary = summarize(results)
            compared = families_json(summary, accept_changes=accept_changes)
            print_json(summary.to_json() | {"comparisons": compared})
            return
        path = path or (folders[0] / FILE if len(folders) == 1 else Path(FILE))
        require_folder_of(path)
        written = write_report(results, path, inline=inline, accept_changes=accept_changes)
        out.print(f"report: {written}")


def export_command(
    folder: Folder,
    path: Annotated[Path, typer.Option("--out", help="File to write; of lerobot, a new folder.")],
    to: Annotated[
        str,
        typer.Option(help="json, csv, parquet: a row an episode; lerobot: a dataset of what was seen."),
    ],
    policy: Annotated[str | None, typer.Option(help="Only this one: NAME, or NAME@STEP in a sweep.")] = None,
    env: Annotated[str | None, typer.Option(help="Only this one.")] = None,
    cameras: Annotated[str | None, typer.Option(help="lerobot: only these, as base,wrist; default: all.")] = None,
    state: Annotated[str | None, typer.Option(help="lerobot: only these parts, in order; default: all.")] = None,
    environment_state: Annotated[
        str | None, typer.Option(help="lerobot: parts for observation.environment_state, as puck,target.")
    ] = None,
    successes: Annotated[bool, typer.Option("--successes", help="lerobot: only episodes that were solved.")] = False,
    cut_idle: Annotated[
        bool, typer.Option("--cut-idle", help="lerobot: end each episode where nothing moves after it was solved.")
    ] = False,
) -> None:
    """Write the episodes of an evaluation as JSON, CSV, Parquet or a LeRobotDataset v3.0."""
    from vlagents_ray.evaluate import Results
    from vlagents_ray.evaluate.artifacts.storage import storing
    from vlagents_ray.evaluate.exports import EXPORTS

    with errors():
        if to not in EXPORTS:
            raise ConfigError(f"--to: got {to!r}, want one of {', '.join(EXPORTS)}")
        named = {"cameras": cameras, "state": state, "environment_state": environment_state}
        chosen: dict[str, Any] = {name: parse_list(value) for name, value in named.items() if value is not None}
        chosen |= {name: True for name, on in (("successes", successes), ("cut_idle", cut_idle)) if on}
        if chosen and to != "lerobot":
            given = ", ".join(f"--{name.replace('_', '-')}" for name in chosen)
            raise ConfigError(f"{given}: got --to {to}, want --to lerobot, whose frames they choose")
        if to in _TABLES:
            require_folder_of(path)
        results = Results.load(folder).only(policy, env)
        with storing(path.parent):
            number = EXPORTS[to](results, path, **chosen)
    out.print(f"wrote {number} episodes to {path}")


def merge_command(
    folders: Annotated[list[Path], typer.Argument(metavar="FOLDER...", help="Folders of results, which stay.")],
    into: Annotated[Path, typer.Option("--out", help="New folder.")],
    keep_first: Annotated[
        bool, typer.Option("--keep-first", help="Of different outcomes of an episode keep that of the first folder.")
    ] = False,
    accept_changes: Annotated[
        bool, typer.Option("--accept-changes", help="Although files or weights differ; the report says so.")
    ] = False,
) -> None:
    """Merge results: each episode once, by its key, with videos and trajectories."""
    from vlagents_ray.evaluate import print_summary
    from vlagents_ray.evaluate.merge import merge

    with errors():
        print_summary(out, merge(into, folders, keep_first=keep_first, accept_changes=accept_changes))


def bundle_command(
    folder: Folder,
    file: Annotated[Path | None, typer.Option("--out", help="The file; default: FOLDER.bundle.zip.")] = None,
    videos: Annotated[bool, typer.Option("--videos", help="With its videos, which may be large.")] = False,
) -> None:
    """Write an evaluation as one file: database, differences from commits, trajectories, digests."""
    from vlagents_ray.evaluate.bundle import write_bundle

    with errors():
        path = file or folder.absolute().with_name(f"{folder.absolute().name}.bundle.zip")
        require_folder_of(path)
        digest = write_bundle(folder, path, videos=videos)
    out.print(f"bundle: {path}, {path.stat().st_size / 1e6:.1f} MB\nto cite: sha256:{digest}")


def verify_command(
    bundle: Annotated[Path, typer.Argument(metavar="BUNDLE", help="A file that `vlagents-ray bundle` wrote.")],
    replay: Annotated[
        int, typer.Option(min=0, max=MOST_EPISODES, help="Episodes whose recorded actions are played again.")
    ] = 3,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0, max=2**32 - 1, help="Draw those episodes by this seed; default: a new one, which is printed."
        ),
    ] = None,
    into: Annotated[Path | None, typer.Option("--out", help="Keep its results in this new folder.")] = None,
    trust: Annotated[bool, typer.Option("--trust", help="Also make environments that name code or files.")] = False,
    max_gb: Annotated[
        float, typer.Option(min=0, max=1e6, callback=finite, help="Refuse a bundle that unpacks to more.")
    ] = 16.0,
    as_json: AsJson = False,
) -> None:
    """Check a bundle, also a stranger's, and print what is equal, differs, or could not be checked.

    Exit code 0 if nothing contradicts it, 1 if something does: a digest, the table, a recording, an outcome of a
    replay. Other versions of software here are only listed.
    """
    from vlagents_ray.evaluate.bundle import verify

    with errors():
        found = verify(bundle, into=into, replay=replay, seed=seed, trust=trust, most_bytes=int(max_gb * 1e9))
        if as_json:
            print_json({"holds": found.holds, **asdict(found)})
        else:
            rows = table("what", "found", "detail", box=None)
            for one in found.findings:
                rows.add_row(one.subject, one.verdict, one.detail)
            out.print(rows)
            unchecked = [one.subject for one in found.findings if one.verdict == "not checked"]
            verdict = "is contradicted" if not found.holds else "holds"
            if unchecked:
                verdict += f"; not checked: {', '.join(unchecked)}"
            if "replay" not in unchecked:
                out.print(f"\nreplayed episodes were drawn by --seed {found.seed}")
            out.print(f"bundle sha256:{found.digest}: {verdict}")
            if into is not None:
                out.print(f"results: {into}")
    raise typer.Exit(not found.holds)


def replay_command(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of results.")],
    episode: Annotated[
        str | None, typer.Argument(help="Its key, or ENV#NUMBER: 'tabletop#3'.", show_default=False)
    ] = None,
    policy: Annotated[str | None, typer.Option(help="Name, deployment file, or URL; default: the run's own.")] = None,
    out_dir: Annotated[Path | None, typer.Option("--out", help="Folder of the replay; default: a new one.")] = None,
    address: Address = None,
) -> None:
    """Play an episode of an evaluation again, and compare: exit code 0 if all is the same."""
    with errors():
        from vlagents_ray.cli.evaluation import play_one
        from vlagents_ray.evaluate import Results
        from vlagents_ray.evaluate.replay import actions_difference, compare, find

        recorded = find(Results.load(folder), episode)
        other: dict[str, Any] | None = (
            None if policy is None else {"source": policy, "url": None, "config": {}, "checkpoint": None}
        )
        into = out_dir or fresh(folder / "replays" / "replay")
        summary = play_one(recorded.config(into, policy=other), address, recorded.number_and_seed)
        found = compare(recorded, summary.results)
        difference = actions_difference(recorded, summary.results)
        steps = recorded.episode.result.steps
        same = f"the same: {steps} actions byte for byte, and what came of them"
        if difference is not None:
            same = (
                f"the same up to rounding: {steps} actions, and what came of them; the first to differ is that of step "
                f"{difference.step}, by {difference.at_first:.2g}, as in batches of another size, later ones differ by "
                f"at most {difference.largest:.2g}"
            )
        for line in [*(found or [same]), f"replay: {into}"]:
            out.print(line)
    raise typer.Exit(bool(found))
