"""Virtual environments, created with uv, for policies that need a separate environment, and for the
other servers in the benchmarks.
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
from vlagents_ray.registry import pip_install, plugin_distributions

Progress = Callable[[str], None]

_CORE = "vlagents-ray"  # the distribution of this package
_FIXES = "vlagents_ray_import_fixes"  # a module and a .pth file in the environments created here
# Files that an installer writes.
_NOT_IN_A_WHEEL = {"RECORD", "INSTALLER", "REQUESTED", "direct_url.json"}
_SHOWN = 2000  # number of characters at the end of uv's output that an error quotes
_CUDA_12 = "torch<2.11"  # the versions whose wheels on PyPI are for CUDA 12
_PYTHON = re.compile(r"^# python: (3\.\d+)\s*$", re.MULTILINE)
_CUDA = re.compile(r"^ \+ ((?:nvidia|cuda)-\S+)", re.MULTILINE)
# pip's variables for package sources, and the corresponding variables of uv, which take precedence.
_PIP_VARIABLES = {
    "PIP_INDEX_URL": "UV_DEFAULT_INDEX",
    "PIP_EXTRA_INDEX_URL": "UV_INDEX",
    "PIP_FIND_LINKS": "UV_FIND_LINKS",
}


def python_in(folder: Path) -> Path:
    """Return the path of the Python of the environment in `folder`."""
    return folder / "bin" / "python"


def create(folder: Path, python: str | None = None, progress: Progress = lambda _: None) -> Path:
    """Create an empty environment in `folder`, unless the folder already contains an environment.

    Args:
        folder: The folder of the environment.
        python: A version or the path of an interpreter; by default the interpreter of this process.
        progress: Called with a line about each step.

    Returns:
        The path of its Python.

    Raises:
        ConfigError: The folder contains something else, or uv cannot create the environment.
    """
    interpreter = python_in(folder)
    if interpreter.exists():
        return interpreter
    if folder.exists() and any(folder.iterdir()):
        raise ConfigError(
            f"{folder}: expected a new folder or a Python environment, got another folder; choose "
            "a new folder"
        )
    progress(f"creating {folder} with Python {python or platform.python_version()}")
    _uv(["venv", "--quiet", "--python", python or sys.executable, str(folder)])
    return interpreter


def find_python(version: str) -> str:
    """Return the path of an interpreter of that minor version, such as "3.12".

    It may be the interpreter of this process, an interpreter on PATH, or an interpreter that pyenv
    or uv has installed for this user.

    Raises:
        ConfigError: There is no such interpreter.
    """
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    uv = Path(os.environ.get("UV_PYTHON_INSTALL_DIR") or Path.home() / ".local/share/uv/python")
    folders = [Path(folder) for folder in os.environ.get("PATH", "").split(os.pathsep) if folder]
    folders += sorted(pyenv.glob(f"{version}.*/bin"))
    folders += sorted(uv.glob(f"cpython-{version}.*/bin"))

    candidates = [Path(sys.executable), *(folder / f"python{version}" for folder in folders)]
    for interpreter in candidates:
        if os.access(interpreter, os.X_OK) and _minor(interpreter) == version:
            return str(interpreter)
    raise ConfigError(
        f"expected Python {version}, which the requirements need, got none: looked for "
        f"python{version} on PATH, in {pyenv} and in {uv}; install it (`uv python install "
        f"{version}`), or give its path: --python /path/to/python{version}"
    )


def install(python: Path, arguments: Sequence[str]) -> None:
    """Run `uv pip install` with these arguments for `python`; raise `ConfigError` with uv's
    output.
    """
    _uv(["pip", "install", "--quiet", "--python", str(python), *arguments])


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
    """Create an environment for a policy, with this package and the installed plug-ins.

    On a machine without an NVIDIA GPU, the new environment gets the torch version of the current
    environment, and the replacements for other requirements in `NAME.cpu.txt`, a file next to
    `requirements`. If the GPU's driver is too old for CUDA 13, it gets a torch for CUDA 12, unless
    `UV_TORCH_BACKEND` is set.

    Args:
        requirements: The requirements file of the policy.
        folder: The folder of the environment.
        more: Further requirements files.
        python: See `create`; by default the version in a line `# python: 3.12` of the requirements,
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
            raise ConfigError(
                f"expected a requirements file, got {str(file)!r}, which does not exist; check "
                "the path"
            )
        if file.suffix == ".py":
            raise ConfigError(
                f"{file}: expected a requirements file, such as needs.txt, got a module of Python"
            )

    is_new = not python_in(folder).exists()
    if python is None and is_new:
        version = _PYTHON.search(requirements.read_text())
        if version is not None:
            python = find_python(version[1])

    interpreter = create(folder, python, progress)
    try:
        _fill(interpreter, files, light=light, cuda=cuda, progress=progress)
    except BaseException:
        if is_new:  # otherwise the folder would later count as a complete environment
            shutil.rmtree(folder)
        raise
    return interpreter


def _fill(
    python: Path, files: Sequence[Path], *, light: bool, cuda: bool, progress: Progress
) -> None:
    """Install this package, the plug-ins and the requirements in `files` for a Python; see
    `make_environment`.
    """
    if not light:
        theirs = _minor(python)
        ours = _minor(Path(sys.executable))
        if theirs != ours:
            progress(
                f"Python {theirs} differs from this environment's {ours}: installing without Ray, "
                "for a child process"
            )
            light = True

    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        arguments = _core(light, scratch)
        for file in files:
            arguments += ["--requirement", str(file)]
        if has_gpu():
            arguments += _constraints_of_driver(scratch, progress)
        else:
            for override in _overrides(files[0], scratch):
                arguments += ["--override", str(override)]
            if not cuda:
                require_no_cuda(python, arguments)

        progress(f"installing {_CORE} {importlib.metadata.version(_CORE)} and {files[0]}")
        install(python, arguments)
        plugins = _plugins(scratch)
        if plugins:
            install(python, ["--no-deps", *plugins])
    _install_import_fixes(python)


def _core(light: bool, scratch: Path) -> list[str]:
    """Return uv's arguments for this package as it is installed here, with the same Ray, or
    pydantic if `light`.

    The package is never installed by its name: an index may contain another package of that name.
    """
    extra = "" if light else "[serve]"
    source = Path(vlagents_ray.__file__).parents[1]
    if (source / "pyproject.toml").is_file():
        arguments = ["--editable", f"{source}{extra}"]
    else:
        arguments = [f"{_CORE}{extra} @ {installed_wheel(scratch).as_uri()}"]

    if not light:
        return [*arguments, f"ray=={importlib.metadata.version('ray')}"]
    for requirement in importlib.metadata.requires(_CORE) or []:
        if requirement.startswith("pydantic"):
            arguments.append(requirement.partition(";")[0].strip())
    return arguments


def _plugins(scratch: Path) -> list[str]:
    """Return uv's arguments for the plug-ins as they are installed here.

    They are installed without dependencies, since the requirements contain the packages of a model
    or a simulator.
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
    # A checkout on Python's path has metadata that do not describe an installation.
    if (checkout / "pyproject.toml").is_file():
        return checkout

    text = installed.read_text("direct_url.json")
    origin = json.loads(text) if text else {}
    if not origin.get("dir_info", {}).get("editable"):
        return None
    return Path(url2pathname(urlparse(origin["url"]).path))


def installed_wheel(folder: Path, distribution: str = _CORE) -> Path:
    """Write a wheel of a distribution, from its installed files, into `folder`, and return its
    path.

    The wheel contains the files and a list of them, see
    https://packaging.python.org/en/latest/specifications/binary-distribution-format.
    """
    installed = importlib.metadata.distribution(distribution)
    files = [file for file in installed.files or () if _is_in_wheel(file)]
    path = folder / f"{distribution.replace('-', '_')}-{installed.version}-py3-none-any.whl"
    record = next(str(file.parent / "RECORD") for file in files if file.name == "METADATA")

    entries = ""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as wheel:
        for file in files:
            wheel.write(file.locate(), str(file))
            if file.hash:
                entries += f"{file},{file.hash.mode}={file.hash.value},{file.size}\n"
        wheel.writestr(record, f"{entries}{record},,\n")
    return path


def _is_in_wheel(file: importlib.metadata.PackagePath) -> bool:
    """Return whether a wheel contains this file of an installed distribution."""
    is_inside = ".." not in file.parts and "__pycache__" not in file.parts
    return is_inside and file.name not in _NOT_IN_A_WHEEL


def _overrides(requirements: Path, scratch: Path) -> list[Path]:
    """Return uv's override files for a machine without a GPU: CPU builds, and the torch of this
    environment.
    """
    overrides = []
    cpu_builds = requirements.with_suffix(f".cpu{requirements.suffix}")
    if cpu_builds.is_file():
        overrides.append(cpu_builds)

    try:
        torch_version = importlib.metadata.version("torch")
    except importlib.metadata.PackageNotFoundError:
        return overrides
    if not overrides or not re.search(r"(?mi)^torch\b(?!-)", cpu_builds.read_text()):
        torch = scratch / "torch.txt"
        torch.write_text(f"torch=={torch_version}\n")
        overrides.append(torch)
    return overrides


def _constraints_of_driver(scratch: Path, progress: Progress) -> list[str]:
    """Return uv's arguments for a torch that runs with this machine's driver, unless uv's own
    variable selects a torch.
    """
    driver = driver_version()
    if (
        "UV_TORCH_BACKEND" in os.environ
        or driver is None
        or int(driver.partition(".")[0]) >= OLDEST_DRIVERS[13]
    ):
        return []

    progress(
        f"the driver, {driver}, is older than {OLDEST_DRIVERS[13]}, the first driver for CUDA 13: "
        f"using {_CUDA_12}"
    )
    constraints = scratch / "constraints.txt"
    constraints.write_text(f"{_CUDA_12}\n")
    return ["--constraint", str(constraints)]


def require_no_cuda(python: Path, arguments: Sequence[str]) -> None:
    """Raise `ConfigError` if `uv pip install` with these arguments would install CUDA packages."""
    plan = _uv(["pip", "install", "--dry-run", "--python", str(python), *arguments])
    cuda_packages = _CUDA.findall(plan)
    if cuda_packages:
        raise ConfigError(
            "stopped before downloading several GB: the requirements include CUDA packages "
            f"({', '.join(cuda_packages[:3])}, …), but this machine has no visible NVIDIA GPU; "
            "list CPU builds in a file NAME.cpu.txt next to NAME.txt, and set their index in "
            "PIP_FIND_LINKS or PIP_INDEX_URL, or install the CUDA packages with --cuda: they also "
            "run on a CPU"
        )


def _install_import_fixes(python: Path) -> None:
    """Install import fixes, with which torchvision and LeRobot load although their wheels do not
    fit this machine.
    """
    command = [str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603
    folder = Path(done.stdout.strip())
    shutil.copyfile(str(import_fixes.__file__), folder / f"{_FIXES}.py")
    (folder / f"{_FIXES}.pth").write_text(f"import {_FIXES}; {_FIXES}.install()\n")


def has_gpu() -> bool:
    """Return whether this machine has a visible NVIDIA GPU, other than a Jetson's, which PyPI's
    torch does not support.
    """
    # WSL2 has no /dev/nvidia0.
    is_wsl = Path("/dev/dxg").exists() and shutil.which("nvidia-smi") is not None
    is_jetson = Path("/etc/nv_tegra_release").exists()
    return (is_wsl or any(Path("/dev").glob("nvidia[0-9]*"))) and not is_jetson


def _minor(python: Path) -> str:
    """Return the minor version of an interpreter, such as "3.12"; "" if the interpreter does not
    run, as is the case for some shims of pyenv.
    """
    command = [str(python), "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()  # noqa: S603


def _uv(arguments: Sequence[str]) -> str:
    """Run uv and return its error output, in which uv reports its steps."""
    if importlib.util.find_spec("uv") is not None:
        command = [sys.executable, "-m", "uv"]
    else:
        folders = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
        binary = shutil.which("uv", path=folders)
        if binary is None:
            raise MissingDependency(f"'uv' is not installed; {pip_install('serve')}")
        command = [binary]

    done = subprocess.run(  # noqa: S603 - uv, as installed with this package
        [*command, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**_package_sources(), **os.environ},
    )
    if done.returncode != 0:
        raise ConfigError(f"uv {arguments[0]} failed:\n{done.stderr.strip()[-_SHOWN:]}")
    return done.stderr


def _package_sources() -> dict[str, str]:
    """Return pip's package sources as variables of uv."""
    sources = {uv: os.environ[pip] for pip, uv in _PIP_VARIABLES.items() if pip in os.environ}
    if "UV_FIND_LINKS" in sources:
        sources["UV_FIND_LINKS"] = ",".join(sources["UV_FIND_LINKS"].split())
    return sources
