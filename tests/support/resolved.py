"""Resolve the requirements of pyproject.toml and of the plug-ins with uv, for the table in
docs/install.md and for the images' lock files.

`python tests/support/resolved.py extras` updates the table, and `… locks` the lock files. Both need
the network.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import tomllib
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "install.md"
LOCKS = ROOT / "cluster" / "docker" / "locks"
TORCH = ROOT / "cluster" / "docker" / "torch.txt"
# RoboCasa needs 10 GB in addition to its packages, and CALVIN a checkout.
WITHOUT_IMAGE = {"robocasa", "calvin"}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
_PLUGIN_FILES = sorted(ROOT.glob("plugins/vlagents_ray_*/pyproject.toml"))
PLUGINS = [tomllib.loads(file.read_text())["project"] for file in _PLUGIN_FILES]
# For Python 3.11 only; "all" installs the plug-ins.
OF_DEVELOPMENT = {"all", "check", "docs", "dev"}
# Extras of the plug-ins, with the requirements of their distribution. No two distributions have an
# extra of the same name.
OF_PLUGINS: dict[str, list[str]] = {
    extra: [*project["dependencies"], *requirements]
    for project in PLUGINS
    for extra, requirements in project.get("optional-dependencies", {}).items()
    if extra not in OF_DEVELOPMENT
}
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"] | OF_PLUGINS
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
SERVER_PYTHON = "3.11"  # Python of the servers in the images
PLATFORM = "x86_64-manylinux_2_36"  # the platform of Debian bookworm
BEGIN, END = "<!-- resolved {} -->", "<!-- /resolved -->"


def direct(extra: str | None) -> list[str]:
    """Return the requirements of an extra, of the extras that it includes, and of the install
    without an extra.
    """
    found = list(PROJECT["dependencies"]) if extra is None else direct(None)
    for text in EXTRAS[extra] if extra else []:
        wanted = Requirement(text)
        if wanted.name != PROJECT["name"]:
            found.append(text)
            continue
        # Sorted, since the order of a set differs between processes.
        for name in sorted(wanted.extras):
            found += direct(name)
    return list(dict.fromkeys(found))


def lines(file: Path) -> list[str]:
    """Return the requirements in a file, without comments."""
    kept = (line.partition(" #")[0].strip() for line in file.read_text().splitlines())
    return [line for line in kept if line and not line.startswith("#")]


def overrides(requirements: Sequence[str]) -> list[str]:
    """Return the lines of torch.txt, except packages whose version the requirements pin, such as
    for another CUDA version.
    """
    wanted = map(Requirement, requirements)
    pinned = {one.name for one in wanted if any(part.operator == "==" for part in one.specifier)}
    return [text for text in lines(TORCH) if Requirement(text).name not in pinned]


def resolve(requirements: Sequence[str], python: str, *words: str) -> list[dict[str, Any]]:
    """Return the resolved packages as in a `pylock.toml`, with `name`, `version`, and the
    `wheels` for the platform.

    Raises:
        LookupError: No versions fit together.
        RuntimeError: uv failed for another reason, such as a missing network.
    """
    command = [
        sys.executable,
        "-m",
        "uv",
        "pip",
        "compile",
        "--quiet",
        "--no-config",
        "--format",
        "pylock.toml",
    ]
    # Otherwise uv would search for that Python, which it does not need to resolve requirements.
    command += ["--no-python-downloads"]
    command += ["--python-version", python, "--python-platform", PLATFORM, *words]
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
        file.write("\n".join(overrides(requirements)))
        file.flush()
        command += ["--override", file.name, "-"]
        done = subprocess.run(
            command, input="\n".join(requirements), capture_output=True, text=True, check=False
        )
    if done.returncode != 0:
        raise (LookupError if "No solution found" in done.stderr else RuntimeError)(done.stderr)
    return list(tomllib.loads(done.stdout)["packages"])


# The table in docs/install.md.


def extras() -> list[str | None]:
    """Return the extras with a row in the table; None is the install without an extra."""
    return [None, *(extra for extra in EXTRAS if extra not in OF_DEVELOPMENT)]


def digest() -> str:
    """Return a digest of everything in this repository on which the table depends."""
    wanted = [PYTHONS, {str(extra): direct(extra) for extra in extras()}, lines(TORCH)]
    return hashlib.sha256(json.dumps(wanted).encode()).hexdigest()[:16]


def cell(extra: str | None, python: str) -> tuple[str, list[str]]:
    """Return the number of packages, and those that must be compiled if wheels alone do not
    suffice.
    """
    found, built = "no", list[str]()
    for words in ([], ["--no-build"]):
        with suppress(LookupError):
            packages = resolve(direct(extra), python, *words)
            built = [f"`{package['name']}`" for package in packages if not package.get("wheels")]
            found = f"{len(packages)}*" if built else str(len(packages))
            if not built:
                break
    return found, built


def table(only: Sequence[str], old: dict[str, str]) -> str:
    """Return the table. The rows in `only` are resolved again, or all rows if it is empty; `old`
    has the other rows.
    """
    with ThreadPoolExecutor(8) as pool:
        cells = {
            extra or "none": [pool.submit(cell, extra, python) for python in PYTHONS]
            for extra in extras()
            if not only or (extra or "none") in only
        }
    heads = ["extra", *(f"Python {python}" for python in PYTHONS), "* compiled"]
    found = [row(*heads), row(*["---"] * len(heads))]
    for extra in extras():
        name = extra or "none"
        if name not in cells:
            found.append(old[name])
            continue
        counts, built = zip(*(one.result() for one in cells[name]), strict=True)
        found.append(
            row(f"`{extra}`" if extra else name, *counts, ", ".join(sorted(set().union(*built))))
        )
    return "\n".join(found)


def row(*texts: str) -> str:
    return "| " + " | ".join(texts).rstrip() + " |"


def rows(page: str) -> dict[str, str]:
    """Return the lines of the page's table by extra."""
    return {line.split("|")[1].strip(" `"): line for line in written(page).splitlines()[3:-1]}


def written(page: str) -> str:
    """Return the table in the page, including the digest before it."""
    found = re.search(f"{BEGIN.format('(.*)')}.*?{END}", page, re.DOTALL)
    if found is None:
        raise ValueError(f"{PAGE} has no {BEGIN.format('DIGEST')} … {END}")
    return found[0]


# The lock files of the images.


def families() -> list[Path]:
    """Return the requirements files of families and simulators that have an image."""
    files = ROOT.glob("plugins/*/*/requirements/*.txt")
    with_image = (file for file in files if "." not in file.stem and file.stem not in WITHOUT_IMAGE)
    return sorted(with_image, key=lambda file: file.stem)


def simulators() -> list[str]:
    """Return the extras of simulators that have an image: all except SIMPLER, which is in
    ManiSkill's image.
    """
    of_core = [extra for extra in EXTRAS if f"{PROJECT['name']}[sim]" in EXTRAS[extra]]
    of_plugins = []
    for extra, requirements in OF_PLUGINS.items():
        extras_of_core = {name for text in requirements for name in Requirement(text).extras}
        if "sim" in extras_of_core and "maniskill" not in extras_of_core:
            of_plugins.append(extra)
    return list(dict.fromkeys([*of_core, *of_plugins]))


def locks() -> dict[str, tuple[str, list[str]]]:
    """Return the Python and the requirements of each lock file by name."""
    servers = ["serve", "sim", *simulators()]
    found = {f"server-{extra}": (SERVER_PYTHON, direct(extra)) for extra in servers}
    for file in families():
        python = re.match(r"# python: (\S+)", file.read_text())
        found[f"family-{file.stem}"] = (
            python[1] if python else SERVER_PYTHON,
            [*direct("serve"), *lines(file)],
        )
    return found


def lock(name: str) -> str:
    """Return a requirements file with all packages, and with digests of the files that fit an
    image.
    """
    python, requirements = locks()[name]
    text = [f"# {name}, for Python {python} on {PLATFORM}: `make locks` writes it."]
    for package in resolve(requirements, python):
        files = package.get("wheels") or [package["sdist"]]
        hashes = sorted(f"--hash=sha256:{file['hashes']['sha256']}" for file in files)
        text.append(" \\\n    ".join([f"{package['name']}=={package['version']}", *hashes]))
    return "\n".join(text) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["extras", "locks"])
    parser.add_argument(
        "only", nargs="*", metavar="NAME", help="extra or lock to update; all by default"
    )
    arguments = parser.parse_args()
    if arguments.what == "extras":
        found = f"{BEGIN.format(digest())}\n{table(arguments.only, rows(PAGE.read_text()))}\n{END}"
        page = PAGE.read_text()
        PAGE.write_text(page.replace(written(page), found))
        return
    wanted = arguments.only or list(locks())
    with ThreadPoolExecutor(8) as pool:
        texts = dict(zip(wanted, pool.map(lock, wanted), strict=True))
    for name, text in texts.items():
        (LOCKS / f"{name}.txt").write_text(text)
    for file in LOCKS.glob("*.txt"):
        if file.stem not in locks():
            file.unlink()


if __name__ == "__main__":
    main()
