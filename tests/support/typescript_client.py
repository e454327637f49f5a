"""The client of clients/typescript, built once for each version of its sources."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

CLIENT = Path(__file__).parents[2] / "clients" / "typescript"
NODE, NPM = shutil.which("node"), shutil.which("npm")
_INSTALLED = CLIENT / "node_modules" / ".package-lock.json"  # npm writes this file last
_BUILT = CLIENT / "dist" / "index.js"


def build() -> Path:
    """Install the dependencies and compile the client unless both are done; return its folder."""
    if (
        not _INSTALLED.exists()
        or _INSTALLED.stat().st_mtime < (CLIENT / "package-lock.json").stat().st_mtime
    ):
        _npm("ci", "--no-audit", "--no-fund", "--prefer-offline")
    sources = [*(CLIENT / "src").glob("*.ts"), CLIENT / "tsconfig.json", _INSTALLED]
    if not _BUILT.exists() or _BUILT.stat().st_mtime < max(
        file.stat().st_mtime for file in sources
    ):
        _npm("run", "build")
        _BUILT.touch()  # the compiler does not rewrite unchanged files
    return CLIENT


def node_version() -> int:
    """Return the major version of Node.js; 0 if Node.js or npm is missing."""
    if NODE is None or NPM is None:
        return 0
    said = subprocess.run([NODE, "--version"], check=True, capture_output=True, text=True).stdout
    return int(said.removeprefix("v").partition(".")[0])


def _npm(*words: str) -> None:
    done = subprocess.run(
        [str(NPM), *words],
        cwd=CLIENT,
        capture_output=True,
        text=True,
        check=False,
        stdin=subprocess.DEVNULL,
    )
    if done.returncode:
        raise RuntimeError(f"npm {' '.join(words)} in {CLIENT}:\n{done.stdout}{done.stderr}")
