"""Resolve the requirements of pyproject.toml and of the plug-ins with uv, for the table in
docs/install.md and for the images' lock files.

`python tests/support/resolved.py extras` writes tests/extras.json, which the site shows as that
table, and `… locks` the lock files. Both need the network.
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
NOTED = ROOT / "tests" / "extras.json"
LOCKS = ROOT / "cluster" / "docker" / "locks"
TORCH = ROOT / "cluster" / "docker" / "torch.txt"
# RoboCasa needs 10 GB in addition to its packages, and CALVIN a checkout.
WITHOUT_IMAGE = {"robocasa", "calvin"}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
_PLUGIN_FILES = sorted(ROOT.glob("plugins/vlagents_ray_*/pyproject.toml"))
PLUGINS = [tomllib.loads(file.read_text())["project"] for file in _PLUGIN_FILES]
# For Python 3.11 only; "all" installs the plug-ins.
OF_DEVELOPMENT = {"all", "check", "dev"}
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


# The packages of each extra.


def extras() -> list[str | None]:
    """Return the extras, and None for the install without an extra."""
    return [None, *(extra for extra in EXTRAS if extra not in OF_DEVELOPMENT)]


def digest(extra: str | None) -> str:
    """Return a digest of everything in this repository on which the packages of an extra depend."""
    wanted = [PYTHONS, direct(extra), lines(TORCH)]
    return hashlib.sha256(json.dumps(wanted).encode()).hexdigest()[:16]


def packages(extra: str | None, python: str) -> tuple[str, list[str]]:
    """Return the number of packages, and those that must be compiled if wheels alone do not
    suffice.
    """
    found, built = "no", list[str]()
    for words in ([], ["--no-build"]):
        with suppress(LookupError):
            needed = resolve(direct(extra), python, *words)
            built = [package["name"] for package in needed if not package.get("wheels")]
            found = f"{len(needed)}*" if built else str(len(needed))
            if not built:
                break
    return found, built


def notes() -> dict[str, dict[str, Any]]:
    """Return the recorded packages of each extra, and of "none": `digest`, `packages`, their number
    for each Python, and `compiled`. A star marks a number that includes compiled packages.
    """
    found: dict[str, dict[str, Any]] = json.loads(NOTED.read_text())
    return found


def resolved_extras(only: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return what `notes` returns, with the extras in `only` resolved again, or all extras if it is
    empty.
    """
    with ThreadPoolExecutor(8) as pool:
        futures = {}
        for extra in extras():
            name = extra or "none"
            if not only or name in only:
                futures[name] = [pool.submit(packages, extra, python) for python in PYTHONS]
    found = {}
    for extra in extras():
        name = extra or "none"
        if name not in futures:
            found[name] = notes()[name]
            continue
        counts, built = zip(*(future.result() for future in futures[name]), strict=True)
        found[name] = {
            "digest": digest(extra),
            "packages": dict(zip(PYTHONS, counts, strict=True)),
            "compiled": sorted(set().union(*built)),
        }
    return found


def write_extras(found: dict[str, dict[str, Any]]) -> None:
    """Write the packages of all extras, a line for each."""
    rows = ",\n".join(f"  {json.dumps(name)}: {json.dumps(row)}" for name, row in found.items())
    NOTED.write_text(f"{{\n{rows}\n}}\n")


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
        write_extras(resolved_extras(arguments.only))
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
