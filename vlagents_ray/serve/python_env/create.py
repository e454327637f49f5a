"""Virtual environments, created with uv, for policies that need one and for the benchmark's
peers.
"""

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
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from urllib.parse import urlparse
from urllib.request import url2pathname

import vlagents_ray
from vlagents_ray.errors import ConfigError, MissingDependency
from vlagents_ray.policies.base import import_fixes
from vlagents_ray.policies.base.accelerator import OLDEST_DRIVERS, driver_version
from vlagents_ray.registry import plugin_distributions

Progress = Callable[[str], None]

_US = "vlagents-ray"
_FIXES = "vlagents_ray_import_fixes"  # a module and a .pth file in the environments created here
# Files that an installer writes.
_NOT_IN_A_WHEEL = {"RECORD", "INSTALLER", "REQUESTED", "direct_url.json"}
_SHOWN = 2000  # number of characters at the end of uv's output that an error quotes
_CUDA_12 = "torch<2.11"  # those whose wheels on PyPI are for CUDA 12
_PYTHON = re.compile(r"^# python: (3\.\d+)\s*$", re.MULTILINE)
_CUDA = re.compile(r"^ \+ ((?:nvidia|cuda)-\S+)", re.MULTILINE)
# pip's variables for package sources, and those of uv, which take precedence.
_PIP_VARIABLES = {
    "PIP_INDEX_URL": "UV_DEFAULT_INDEX",
    "PIP_EXTRA_INDEX_URL": "UV_INDEX",
    "PIP_FIND_LINKS": "UV_FIND_LINKS",
}


def python_in(folder: Path) -> Path:
    """Return the path of the Python of the environment in `folder`."""
    return folder / "bin" / "python"


def create(folder: Path, python: str | None = None, progress: Progress = lambda _: None) -> Path:
    """Create an empty environment in `folder`, unless there is one already.

    Args:
        folder: The folder of the environment.
        python: A version or the path of an interpreter; by default this process's.
        progress: Called with a line about each step.

    Returns:
        The path of its Python.

    Raises:
        ConfigError: The folder contains something else, or uv cannot create the environment.
    """
    found = python_in(folder)
    if found.exists():
        return found
    if folder.exists() and any(folder.iterdir()):
        raise ConfigError(
            f"{folder}: is there and holds no Python environment; name another folder"
        )
    progress(f"making {folder} with Python {python or platform.python_version()}")
    _uv(["venv", "--quiet", "--python", python or sys.executable, str(folder)])
    return found


def find_python(version: str) -> str:
    """Return the path of an interpreter of that minor version, such as "3.12".

    It may be this process's own, one on PATH, or one that pyenv or uv has installed for this user.

    Raises:
        ConfigError: There is no such interpreter.
    """
    folders = [Path(folder) for folder in os.environ.get("PATH", "").split(os.pathsep) if folder]
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    uv = Path(os.environ.get("UV_PYTHON_INSTALL_DIR") or Path.home() / ".local/share/uv/python")
    installed = [
        *sorted(pyenv.glob(f"{version}.*/bin")),
        *sorted(uv.glob(f"cpython-{version}.*/bin")),
    ]
    for one in [
        Path(sys.executable),
        *(folder / f"python{version}" for folder in [*folders, *installed]),
    ]:
        if os.access(one, os.X_OK) and _minor(one) == version:
            return str(one)
    raise ConfigError(
        f"found no Python {version}, which the requirements want: looked for python{version} on "
        f"PATH, in {pyenv} "
        f"and in {uv}; install it (`uv python install {version}`), or name one: --python "
        f"/path/to/python{version}"
    )


def install(python: Path, wanted: Sequence[str]) -> None:
    """Install `wanted`, arguments of `uv pip install`, for `python`; raise `ConfigError` with
    uv's output.
    """
    _uv(["pip", "install", "--quiet", "--python", str(python), *wanted])


def make_environment(
    requirements: Path,
    folder: Path,
    *,
    more: Sequence[Path] = (),
    python: str | None = None,
    light: bool = False,
    cuda: bool = False,
    progress: Progress = lambda _: None,
) -> Path:
    """Create an environment for a policy, with this package and the installed plug-ins in it.

    On a machine without an NVIDIA GPU it gets the version of torch of this environment, and the
    replacements for other requirements in `NAME.cpu.txt`, in the folder of `requirements`. Where
    the GPU's driver is too old for CUDA 13, it gets a torch for CUDA 12, unless `UV_TORCH_BACKEND`
    is set.

    Args:
        requirements: The requirements file of the policy.
        folder: The folder of the environment.
        more: Further requirements files.
        python: See `create`; by default the version that the requirements name, `# python: 3.12`,
            if any.
        light: Whether to omit Ray, for a child process; always true for another Python minor
            version, in which no replica can run.
        cuda: Whether CUDA packages, which take several GB, may be installed without an NVIDIA GPU.
        progress: Called with a line about each step.

    Returns:
        The path of its Python.

    Raises:
        ConfigError: A file or the Python does not exist, uv fails, or a CUDA build would be
            installed without an NVIDIA GPU. A folder that this call created is removed.
    """
    files = [requirements, *more]
    for file in files:
        if not file.is_file():
            raise ConfigError(f"no such file: got {str(file)!r}, want a requirements file")
        if file.suffix == ".py":
            raise ConfigError(
                f"{file}: expected a requirements file, such as needs.txt, got a module of Python"
            )
    if (
        python is None
        and not python_in(folder).exists()
        and (wanted := _PYTHON.search(requirements.read_text()))
    ):
        python = find_python(wanted[1])
    is_new = not python_in(folder).exists()
    made = create(folder, python, progress)
    try:
        _fill(made, files, light=light, cuda=cuda, progress=progress)
    except BaseException:
        if is_new:  # otherwise it would later be taken for a complete environment
            shutil.rmtree(folder)
        raise
    return made


def _fill(
    made: Path, files: Sequence[Path], *, light: bool, cuda: bool, progress: Progress
) -> None:
    """Install this package, the plug-ins and the requirements in `files` for a Python; see
    `make_environment`.
    """
    if not light and (theirs := _minor(made)) != (ours := _minor(Path(sys.executable))):
        progress(f"Python {theirs} is not this one's {ours}: without Ray, for a child process")
        light = True
    with tempfile.TemporaryDirectory() as scratch:
        asked = [*_ourselves(light, Path(scratch))]
        asked += [word for file in files for word in ("--requirement", str(file))]
        if has_gpu():
            asked += _for_driver(Path(scratch), progress)
        else:
            for override in _overrides(files[0], Path(scratch)):
                asked += ["--override", str(override)]
            if not cuda:
                require_no_cuda(made, asked)
        progress(f"installing {_US} {importlib.metadata.version(_US)} and {files[0]}")
        install(made, asked)
        plugins = _plugins(Path(scratch))
        if plugins:
            install(made, ["--no-deps", *plugins])
    _install_import_fixes(made)


def _ourselves(light: bool, scratch: Path) -> list[str]:
    """Return uv's arguments for this package as it is installed here, with the same Ray, or
    pydantic if `light`.

    The package is never installed by its name: an index may have another package of that name.
    """
    extra = "" if light else "[serve]"
    source = Path(vlagents_ray.__file__).parents[1]
    if (source / "pyproject.toml").is_file():
        us = ["--editable", f"{source}{extra}"]
    else:
        us = [f"{_US}{extra} @ {installed_wheel(scratch).as_uri()}"]
    if not light:
        return [*us, f"ray=={importlib.metadata.version('ray')}"]
    needed = importlib.metadata.requires(_US) or []
    return [*us, *(one.partition(";")[0].strip() for one in needed if one.startswith("pydantic"))]


def _plugins(scratch: Path) -> list[str]:
    """Return uv's arguments for the plug-ins as they are installed here.

    They are installed without their dependencies: those of a model or a simulator are in the
    requirements.
    """
    arguments = []
    for distribution in plugin_distributions():
        source = _editable_source(importlib.metadata.distribution(distribution))
        if source is not None:
            arguments += ["--editable", str(source)]
        else:
            arguments.append(str(installed_wheel(scratch, distribution)))
    return arguments


def _editable_source(installed: importlib.metadata.Distribution) -> Path | None:
    """Return the folder of a distribution that is installed as editable, or found in a checkout;
    None for any other.

    See https://packaging.python.org/en/latest/specifications/direct-url.
    """
    checkout = Path(str(installed.locate_file("")))
    # On the path of modules: its metadata are not an installation's.
    if (checkout / "pyproject.toml").is_file():
        return checkout
    text = installed.read_text("direct_url.json")
    origin = json.loads(text) if text else {}
    if not origin.get("dir_info", {}).get("editable"):
        return None
    return Path(url2pathname(urlparse(origin["url"]).path))


def installed_wheel(folder: Path, distribution: str = _US) -> Path:
    """Write a wheel of a distribution, from its installed files, into `folder`, and return its
    path.

    The wheel contains the files and a list of them, see
    https://packaging.python.org/en/latest/specifications/binary-distribution-format.
    """
    here = importlib.metadata.distribution(distribution)
    kept = [
        file
        for file in here.files or ()
        if ".." not in file.parts
        and "__pycache__" not in file.parts
        and file.name not in _NOT_IN_A_WHEEL
    ]
    made = folder / f"{distribution.replace('-', '_')}-{here.version}-py3-none-any.whl"
    record = next(str(file.parent / "RECORD") for file in kept if file.name == "METADATA")
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as wheel:
        for file in kept:
            wheel.write(file.locate(), str(file))
        listed = "".join(
            f"{file},{file.hash.mode}={file.hash.value},{file.size}\n" for file in kept if file.hash
        )
        wheel.writestr(record, f"{listed}{record},,\n")
    return made


def _overrides(requirements: Path, scratch: Path) -> list[Path]:
    """Return files with replacements of requirements for a machine without a GPU."""
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


def _for_driver(scratch: Path, progress: Progress) -> list[str]:
    """Return uv's arguments for a torch that runs with this machine's driver, unless uv's own
    variable chooses one.
    """
    driver = driver_version()
    if (
        "UV_TORCH_BACKEND" in os.environ
        or driver is None
        or int(driver.partition(".")[0]) >= OLDEST_DRIVERS[13]
    ):
        return []
    progress(
        f"the driver, {driver}, is older than {OLDEST_DRIVERS[13]}, the first for CUDA 13: taking "
        f"{_CUDA_12}"
    )
    constraints = scratch / "constraints.txt"
    constraints.write_text(f"{_CUDA_12}\n")
    return ["--constraint", str(constraints)]


def require_no_cuda(python: Path, wanted: Sequence[str]) -> None:
    plan = _uv(["pip", "install", "--dry-run", "--python", str(python), *wanted])
    if found := _CUDA.findall(plan):
        raise ConfigError(
            "stopped before downloading several GB: the requirements bring CUDA packages "
            f"({', '.join(found[:3])}, …), "
            "but this machine shows no NVIDIA GPU; name CPU builds in a file NAME.cpu.txt beside "
            "NAME.txt, and where "
            "they are with PIP_FIND_LINKS or PIP_INDEX_URL, or take these, --cuda: they run on a "
            "CPU, too"
        )


def _install_import_fixes(python: Path) -> None:
    """Install import fixes, with which torchvision and LeRobot load although their wheels do not
    fit this machine.
    """
    command = [str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    folder = Path(
        subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()  # noqa: S603
    )
    shutil.copyfile(str(import_fixes.__file__), folder / f"{_FIXES}.py")
    (folder / f"{_FIXES}.pth").write_text(f"import {_FIXES}; {_FIXES}.install()\n")


def has_gpu() -> bool:
    """Return whether this machine shows an NVIDIA GPU, other than a Jetson's, which PyPI's torch
    does not support.
    """
    # WSL2 has no /dev/nvidia0.
    on_wsl = Path("/dev/dxg").exists() and shutil.which("nvidia-smi") is not None
    return (on_wsl or any(Path("/dev").glob("nvidia[0-9]*"))) and not Path(
        "/etc/nv_tegra_release"
    ).exists()


def _minor(python: Path) -> str:
    """Return the minor version of an interpreter, such as "3.12"; "" if it does not run, as some
    shims of pyenv.
    """
    command = [str(python), "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()  # noqa: S603


def _uv(arguments: Sequence[str]) -> str:
    """Run uv and return its error output, which reports its work."""
    if importlib.util.find_spec("uv") is not None:
        command = [sys.executable, "-m", "uv"]
    else:
        beside = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
        if (binary := shutil.which("uv", path=beside)) is None:
            raise MissingDependency("'uv' is not installed; pip install 'vlagents-ray[serve]'")
        command = [binary]
    done = subprocess.run(  # noqa: S603 - uv, as installed with this package
        [*command, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**_places(), **os.environ},
    )
    if done.returncode != 0:
        raise ConfigError(f"uv {arguments[0]} failed:\n{done.stderr.strip()[-_SHOWN:]}")
    return done.stderr


def _places() -> dict[str, str]:
    """Return pip's package sources as variables of uv."""
    places = {uv: os.environ[pip] for pip, uv in _PIP_VARIABLES.items() if pip in os.environ}
    if "UV_FIND_LINKS" in places:
        places["UV_FIND_LINKS"] = ",".join(places["UV_FIND_LINKS"].split())
    return places
