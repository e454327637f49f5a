"""Check the consistency of a version before it is published: `make release` runs this file first.

The version is in `pyproject.toml`. Other files repeat it, and the changelog has a section for it.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import tomllib

ROOT = Path(__file__).parents[2]
VERSION: str = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
# The files that repeat the version, and the text before it.
REPEATED = {
    "CITATION.cff": r"^version: ",
    "cluster/ray/aws.yaml": r"image: REGISTRY/vlagents-ray:",
    "cluster/kuberay/reader.yaml": r"image: vlagents-ray:",
    "cluster/kuberay/job.yaml": r"image: vlagents-ray:",
    "cluster/kuberay/service.yaml": r"image: vlagents-ray:",
}


def other_versions() -> list[str]:
    """Return one line for each file that names another version than `pyproject.toml`."""
    lines = []
    for name, before in REPEATED.items():
        text = (ROOT / name).read_text()
        versions = set(re.findall(rf"{before}([\w.]+)", text, re.MULTILINE))
        if versions != {VERSION}:
            lines.append(f"{name}: expected version {VERSION}, got {sorted(versions)}")
    return lines


def unfinished(changelog: str) -> list[str]:
    """Return the parts that the changelog lacks for the release of this version."""
    if re.search(rf"^## \[{re.escape(VERSION)}\] - \d{{4}}-\d\d-\d\d$", changelog, re.MULTILINE):
        return []
    return [f"CHANGELOG.md: expected a heading '## [{VERSION}] - YYYY-MM-DD'"]


def denials() -> list[str]:
    """Return one line for each page with the statement that the package is not released."""
    pages = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
    return [
        f"{page.relative_to(ROOT)}: expected no sentence that this version is not released"
        for page in pages
        if re.search(r"\bnot\s+released\b", page.read_text())
    ]


def changed_files() -> list[str]:
    """Return one line if the working tree differs from its commit."""
    command = ["git", "-C", ROOT, "status", "--porcelain"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return ["expected a clean working tree; commit or stash your changes"] if done.stdout else []


def main() -> int:
    """Print each problem, or the version if there is none; return the exit status."""
    changelog = (ROOT / "CHANGELOG.md").read_text()
    problems = [*other_versions(), *unfinished(changelog), *denials(), *changed_files()]
    print(*(problems or [VERSION]), sep="\n", file=sys.stderr if problems else sys.stdout)
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
