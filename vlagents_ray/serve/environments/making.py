"""Virtual environments, made by uv: a policy's beside the server's, and the benchmark's peers'."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import vlagents_ray
from vlagents_ray.errors import ConfigError, MissingDependency

Tell = Callable[[str], None]

_US = "vlagents-ray"
_SHOWN = 2000  # characters of uv's last words
_MINOR = "import sys; print('%d.%d' % sys.version_info[:2])"
_CUDA = re.compile(r"^ \+ ((?:nvidia|cuda)-\S+)", re.MULTILINE)
# Where pip was told to look; uv has variables of its own, which win.
_PIP_VARIABLES = {
    "PIP_INDEX_URL": "UV_DEFAULT_INDEX",
    "PIP_EXTRA_INDEX_URL": "UV_INDEX",
    "PIP_FIND_LINKS": "UV_FIND_LINKS",
}


def python_in(folder: Path) -> Path:
    """The Python of the environment in `folder`."""
    return folder / "bin" / "python"


def create(folder: Path, python: str | None = None, tell: Tell = lambda _: None) -> Path:
    """Make an empty environment in `folder`, unless there is one; returns its Python.

    `python` is a version or an interpreter's path, by default this one. `ConfigError` if uv cannot make it.
    """
    found = python_in(folder)
    if found.exists():
        return found
    if folder.exists() and any(folder.iterdir()):
        raise ConfigError(f"{folder}: is there and holds no Python environment; name another folder")
    tell(f"making {folder} with Python {python or platform.python_version()}")
    _uv(["venv", "--quiet", "--python", python or sys.executable, str(folder)])
    return found


def install(python: Path, wanted: Sequence[str]) -> None:
    """Have uv install `wanted`, its arguments, into the environment of `python`; `ConfigError` with its last words."""
    _uv(["pip", "install", "--quiet", "--python", str(python), *wanted])


def make_environment(
    requirements: Path,
    folder: Path,
    *,
    more: Sequence[Path] = (),
    python: str | None = None,
    light: bool = False,
    tell: Tell = lambda _: None,
) -> Path:
    """An environment for the policy that needs `requirements`, with this same package in it; returns its Python.

    `more` are further requirements files.

    `light`: without Ray, for a child process; so is that of another Python minor, in which no replica can run.
    On a machine without an NVIDIA GPU it gets this environment's own torch, and what `NAME.cpu.txt`, beside
    `requirements`, puts in the place of other requirements. Raises `ConfigError` before a CUDA build would come there.
    """
    files = [requirements, *more]
    for file in files:
        if not file.is_file():
            raise ConfigError(f"no such file: got {str(file)!r}, want a requirements file")
    made = create(folder, python, tell)
    if not light and _minor(made) != _minor(Path(sys.executable)):
        tell(
            f"Python {_minor(made)} is not this one's {_minor(Path(sys.executable))}: without Ray, for a child process"
        )
        light = True
    wanted = [*_ourselves(light), *(word for file in files for word in ("--requirement", str(file)))]
    with tempfile.TemporaryDirectory() as scratch:
        if not _has_gpu():
            for override in _overrides(requirements, Path(scratch)):
                wanted += ["--override", str(override)]
            _require_no_cuda(made, wanted)
        tell(f"installing {_US} {importlib.metadata.version(_US)} and {requirements}")
        install(made, wanted)
    return made


def _ourselves(light: bool) -> list[str]:
    """uv's arguments for this package as it is installed here, and what of Ray or pydantic goes with it."""
    extra = "" if light else "[serve]"
    source = Path(vlagents_ray.__file__).parents[1]
    direct = importlib.metadata.distribution(_US).read_text("direct_url.json")
    if (source / "pyproject.toml").is_file():
        us = ["--editable", f"{source}{extra}"]
    elif direct is not None:
        us = [f"{_US}{extra} @ {json.loads(direct)['url']}"]
    else:
        us = [f"{_US}{extra}=={importlib.metadata.version(_US)}"]
    if not light:
        return [*us, f"ray=={importlib.metadata.version('ray')}"]
    needed = importlib.metadata.requires(_US) or []
    return [*us, *(one.partition(";")[0].strip() for one in needed if one.startswith("pydantic"))]


def _overrides(requirements: Path, scratch: Path) -> list[Path]:
    """Files with what replaces requirements where there is no GPU."""
    found = []
    theirs = requirements.with_suffix(f".cpu{requirements.suffix}")
    if theirs.is_file():
        found.append(theirs)
    try:
        torch = importlib.metadata.version("torch")
    except importlib.metadata.PackageNotFoundError:
        return found
    if not found or not re.search(r"(?mi)^torch\b(?!-)", theirs.read_text()):
        ours = scratch / "torch.txt"
        ours.write_text(f"torch=={torch}\n")
        found.append(ours)
    return found


def _require_no_cuda(python: Path, wanted: Sequence[str]) -> None:
    plan = _uv(["pip", "install", "--dry-run", "--python", str(python), *wanted])
    if found := _CUDA.findall(plan):
        raise ConfigError(
            f"stopped before downloading several GB: the requirements bring CUDA packages ({', '.join(found[:3])}, …), "
            f"but this machine shows no NVIDIA GPU; name CPU builds in a file NAME.cpu.txt beside NAME.txt, and where "
            f"they are with PIP_FIND_LINKS or PIP_INDEX_URL"
        )


def _has_gpu() -> bool:
    return any(Path("/dev").glob("nvidia[0-9]*"))


def _minor(python: Path) -> str:
    command = [str(python), "-c", _MINOR]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()  # noqa: S603


def _uv(arguments: Sequence[str]) -> str:
    """Run uv; returns what it said of its work."""
    if importlib.util.find_spec("uv") is not None:
        command = [sys.executable, "-m", "uv"]
    else:
        beside = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
        binary = shutil.which("uv", path=beside)
        if binary is None:
            raise MissingDependency("'uv' is not installed; pip install 'vlagents-ray[serve]'")
        command = [binary]
    done = subprocess.run(  # noqa: S603 - uv, as installed with this package
        [*command, *arguments], capture_output=True, text=True, check=False, env={**_places(), **os.environ}
    )
    if done.returncode != 0:
        raise ConfigError(f"uv {arguments[0]} failed:\n{done.stderr.strip()[-_SHOWN:]}")
    return done.stderr


def _places() -> dict[str, str]:
    """Where pip was told to look, as uv is told."""
    places = {uv: os.environ[pip] for pip, uv in _PIP_VARIABLES.items() if pip in os.environ}
    if "UV_FIND_LINKS" in places:
        places["UV_FIND_LINKS"] = ",".join(places["UV_FIND_LINKS"].split())
    return places
