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
        list[Path],
        typer.Argument(metavar="FOLDER...", help="Folders of results, which are not changed."),
    ],
    into: Annotated[Path, typer.Option("--out", metavar="FOLDER", help="New folder.")],
    keep_first: Annotated[
        bool,
        typer.Option(
            "--keep-first",
            help="If folders have different outcomes of an episode, keep the outcome of the first "
            "folder.",
        ),
    ] = False,
    accept_changes: Annotated[
        bool,
        typer.Option(
            "--accept-changes",
            help="Merge even if files or weights differ. The report lists the differences.",
        ),
    ] = False,
) -> None:
    """Merge results, so that each episode occurs once, with its videos and trajectories."""
    from vlagents_ray.evaluate import print_summary
    from vlagents_ray_results.merge import merge

    with errors():
        print_summary(
            out, merge(into, folders, keep_first=keep_first, accept_changes=accept_changes)
        )


def bundle_command(
    folder: Folder,
    file: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="The bundle; default: FOLDER.bundle.zip."),
    ] = None,
    videos: Annotated[
        bool, typer.Option("--videos", help="Include the videos, which may be large.")
    ] = False,
) -> None:
    """Write an evaluation as one file that others can verify: its database, the changes of the
    code since its commit, the trajectories, and digests of all files.
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
            min=0,
            max=MOST_EPISODES,
            metavar="N",
            help="Number of episodes whose recorded actions are executed again.",
        ),
    ] = 3,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=2**32 - 1,
            metavar="N",
            help="Seed with which these episodes are drawn; default: a new one, which is printed.",
        ),
    ] = None,
    into: Annotated[
        Path | None,
        typer.Option("--out", metavar="FOLDER", help="Keep the results in this new folder."),
    ] = None,
    trust: Annotated[
        bool,
        typer.Option("--trust", help="Also create environments whose settings name code or files."),
    ] = False,
    max_gb: Annotated[
        float,
        typer.Option(
            min=0,
            max=1e6,
            callback=finite,
            metavar="GB",
            help="Reject a bundle whose content is larger than this, in GB.",
        ),
    ] = 16.0,
    as_json: AsJson = False,
) -> None:
    """Check a bundle, and print which parts are equal, differ, or could not be checked.

    The bundle may come from a stranger. Different versions of software on this machine are listed,
    but do not contradict the bundle.

    Exit status: 0 if nothing contradicts the bundle, 1 if a digest, the table of results, a
    recording or the outcome of a replay does.
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
