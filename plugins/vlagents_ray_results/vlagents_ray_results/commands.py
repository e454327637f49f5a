"""The commands `vlagents-ray merge`, `bundle` and `verify`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from vlagents_ray.bounds import MOST_EPISODES
from vlagents_ray.cli.console import errors, out, print_json, table
from vlagents_ray.cli.options import AsJson, finite
from vlagents_ray.cli.results import Folder


def merge_command(
    folders: Annotated[
        list[Path], typer.Argument(metavar="FOLDER...", help="Folders of results, which stay.")
    ],
    into: Annotated[Path, typer.Option("--out", help="New folder.")],
    keep_first: Annotated[
        bool,
        typer.Option(
            "--keep-first",
            help="Of different outcomes of an episode keep that of the first folder.",
        ),
    ] = False,
    accept_changes: Annotated[
        bool,
        typer.Option(
            "--accept-changes", help="Although files or weights differ; the report says so."
        ),
    ] = False,
) -> None:
    """Merge results: each episode once, by its key, with videos and trajectories."""
    from vlagents_ray.evaluate import print_summary
    from vlagents_ray_results.merge import merge

    with errors():
        print_summary(
            out, merge(into, folders, keep_first=keep_first, accept_changes=accept_changes)
        )


def bundle_command(
    folder: Folder,
    file: Annotated[
        Path | None, typer.Option("--out", help="The file; default: FOLDER.bundle.zip.")
    ] = None,
    videos: Annotated[
        bool, typer.Option("--videos", help="With its videos, which may be large.")
    ] = False,
) -> None:
    """Write an evaluation as one file: database, differences from commits, trajectories,
    digests.
    """
    from vlagents_ray.evaluate.artifacts.storage import require_folder_of
    from vlagents_ray_results.bundle import write_bundle

    with errors():
        path = file or folder.absolute().with_name(f"{folder.absolute().name}.bundle.zip")
        require_folder_of(path)
        digest = write_bundle(folder, path, videos=videos)
    out.print(f"bundle: {path}, {path.stat().st_size / 1e6:.1f} MB\nto cite: sha256:{digest}")


def verify_command(
    bundle: Annotated[
        Path, typer.Argument(metavar="BUNDLE", help="A file that `vlagents-ray bundle` wrote.")
    ],
    replay: Annotated[
        int,
        typer.Option(
            min=0, max=MOST_EPISODES, help="Episodes whose recorded actions are played again."
        ),
    ] = 3,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=2**32 - 1,
            help="Draw those episodes by this seed; default: a new one, which is printed.",
        ),
    ] = None,
    into: Annotated[
        Path | None, typer.Option("--out", help="Keep its results in this new folder.")
    ] = None,
    trust: Annotated[
        bool, typer.Option("--trust", help="Also make environments that name code or files.")
    ] = False,
    max_gb: Annotated[
        float,
        typer.Option(min=0, max=1e6, callback=finite, help="Refuse a bundle that unpacks to more."),
    ] = 16.0,
    as_json: AsJson = False,
) -> None:
    """Check a bundle, also a stranger's, and print what is equal, differs, or could not be checked.

    Exit code 0 if nothing contradicts it, 1 if something does: a digest, the table, a recording, an
    outcome of a replay. Other versions of software here are only listed.
    """
    from vlagents_ray_results.verification import verify

    with errors():
        verification = verify(
            bundle, into=into, replay=replay, seed=seed, trust=trust, most_bytes=int(max_gb * 1e9)
        )
        if as_json:
            print_json({"holds": verification.holds, **asdict(verification)})
        else:
            rows = table("what", "found", "detail", box=None)
            for finding in verification.findings:
                rows.add_row(finding.subject, finding.verdict, finding.detail)
            out.print(rows)

            unchecked = []
            for finding in verification.findings:
                if finding.verdict == "not checked":
                    unchecked.append(finding.subject)

            verdict = "is contradicted" if not verification.holds else "holds"
            if unchecked:
                verdict += f"; not checked: {', '.join(unchecked)}"
            if "replay" not in unchecked:
                out.print(f"\nreplayed episodes were drawn by --seed {verification.seed}")
            out.print(f"bundle sha256:{verification.digest}: {verdict}")
            if into is not None:
                out.print(f"results: {into}")
    raise typer.Exit(not verification.holds)
