"""`vlagents-ray venv create` without downloads. tests/integration/test_environments.py uses real
environments.
"""

from __future__ import annotations

import importlib.metadata
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from vlagents_ray.errors import ConfigError, MissingDependency
from vlagents_ray.policies.base import accelerator
from vlagents_ray.registry import pip_install
from vlagents_ray.serve.python_env import create as making
from vlagents_ray.serve.python_env.create import create, find_python, make_environment


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a growing list of uv's arguments, with the text of overrides and constraints. Nothing
    is installed.
    """
    told: list[str] = []

    def uv(arguments: Sequence[str]) -> str:
        if arguments[0] == "venv":
            return real(arguments)
        files = [
            Path(arguments[i + 1])
            for i, word in enumerate(arguments)
            if word in ("--override", "--constraint")
        ]
        told.append(" ".join(arguments) + " " + " ".join(file.read_text() for file in files))
        return ""

    real = making._uv
    monkeypatch.setattr(making, "_uv", uv)
    # The plug-ins of this environment would add another call of uv.
    monkeypatch.setattr(making, "plugin_distributions", list)
    return told


@pytest.fixture
def requirements(tmp_path: Path) -> Path:
    file = tmp_path / "some.txt"
    file.write_text("six==1.16.0\n")
    return file


def test_it_holds_this_package_with_the_same_ray_and_the_requirements(
    asked: list[str], requirements: Path, tmp_path: Path
) -> None:
    python = make_environment(requirements, tmp_path / "env")
    assert python.is_file()
    source = Path(making.__file__).parents[3]
    for word in (
        f"--python {python} --editable {source}[serve] ray=={importlib.metadata.version('ray')}",
        f"--requirement {requirements}",
    ):
        assert word in asked[-1]


def test_a_plugin_on_the_path_of_modules_is_installed_from_its_checkout(
    asked: list[str], requirements: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plug-in may be on PYTHONPATH; setuptools wrote its metadata next to its sources."""
    checkout = tmp_path / "checkout"
    metadata = checkout / "some_plugin.egg-info" / "PKG-INFO"
    metadata.parent.mkdir(parents=True)
    metadata.write_text("Metadata-Version: 2.4\nName: some-plugin\nVersion: 0.1.0\n")
    (checkout / "pyproject.toml").touch()
    monkeypatch.syspath_prepend(checkout)
    monkeypatch.setattr(making, "plugin_distributions", lambda: ["some-plugin"])
    make_environment(requirements, tmp_path / "env")
    assert f"--no-deps --editable {checkout}" in asked[-1]


def test_one_that_cannot_be_filled_is_removed_unless_it_was_there(
    monkeypatch: pytest.MonkeyPatch, requirements: Path, tmp_path: Path
) -> None:
    def fails(_python: Path, _wanted: Sequence[str]) -> None:
        raise ConfigError("uv pip failed")

    monkeypatch.setattr(making, "install", fails)
    existing, new = tmp_path / "existing", tmp_path / "new"
    python = create(existing)
    for folder in (existing, new):
        with pytest.raises(ConfigError, match="uv pip failed"):
            make_environment(requirements, folder, cuda=True)
    assert python.exists()
    assert not new.exists()


def test_a_light_one_and_one_of_another_python_are_without_ray(
    asked: list[str], requirements: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_environment(requirements, tmp_path / "light", light=True)
    assert "ray==" not in asked[-1]
    assert "[serve]" not in asked[-1]
    assert "pydantic>=" in asked[-1]
    monkeypatch.setattr(
        making, "_minor", lambda python: "3.11" if python == Path(sys.executable) else "3.12"
    )
    said: list[str] = []
    make_environment(requirements, tmp_path / "env", progress=said.append)
    assert "ray==" not in asked[-1]
    assert (
        "Python 3.12 differs from this environment's 3.11: installing without Ray, for a child process"
        in said
    )


OWN = "{}.{}".format(*sys.version_info[:2])


def interpreter(path: Path, says: str) -> Path:
    """Write a shell script in place of a Python interpreter."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{says}\n")
    path.chmod(0o755)
    return path


class TestThePythonThatRequirementsName:
    @pytest.fixture(autouse=True)
    def places(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        for name, folder in (
            ("PATH", "one:two"),
            ("PYENV_ROOT", "pyenv"),
            ("UV_PYTHON_INSTALL_DIR", "uv"),
        ):
            monkeypatch.setenv(name, ":".join(f"{tmp_path}/{one}" for one in folder.split(":")))

    def test_is_this_one_or_one_that_runs_and_is_that_version(self, tmp_path: Path) -> None:
        assert find_python(OWN) == sys.executable
        # A shim of pyenv for a version that is not installed.
        interpreter(tmp_path / "one" / "python3.97", "exit 127")
        in_uv = interpreter(
            tmp_path / "uv" / "cpython-3.97.0-linux" / "bin" / "python3.97", "echo 3.97"
        )
        assert find_python("3.97") == str(in_uv)
        in_pyenv = interpreter(
            tmp_path / "pyenv" / "versions" / "3.97.2" / "bin" / "python3.97", "echo 3.97"
        )
        assert find_python("3.97") == str(in_pyenv)
        on_path = interpreter(tmp_path / "two" / "python3.97", "echo 3.97")
        assert find_python("3.97") == str(on_path)

    def test_is_taken_unless_another_is_asked_for(
        self, asked: list[str], requirements: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        requirements.write_text(f"# python: {OWN}\nsix==1.16.0\n")
        assert make_environment(requirements, tmp_path / "env").is_file()
        requirements.write_text("# python: 3.97\nsix==1.16.0\n")
        assert make_environment(requirements, tmp_path / "other", python=sys.executable).is_file()
        with pytest.raises(
            ConfigError, match=r"expected Python 3\.97, .*python3\.97 on PATH.*--python"
        ):
            make_environment(requirements, tmp_path / "third")
        assert not (tmp_path / "third").exists()


def own_torch() -> str:
    return f"torch=={importlib.metadata.version('torch')}"


class TestWithoutAGpu:
    @pytest.fixture(autouse=True)
    def no_gpu(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(making, "has_gpu", lambda: False)

    @pytest.mark.torch
    def test_torch_is_this_environments_own(
        self, asked: list[str], requirements: Path, tmp_path: Path
    ) -> None:
        make_environment(requirements, tmp_path / "env")
        assert f"{own_torch()}\n" in asked[-1]

    @pytest.mark.torch
    def test_a_file_beside_the_requirements_replaces_more(
        self, asked: list[str], requirements: Path, tmp_path: Path
    ) -> None:
        beside = tmp_path / "some.cpu.txt"
        beside.write_text("torchvision==0.1\n")
        make_environment(requirements, tmp_path / "env")
        assert f"--override {beside}" in asked[-1]
        assert own_torch() in asked[-1], "torchvision is not torch"
        beside.write_text("torch==1.2.3\n")
        make_environment(requirements, tmp_path / "env")
        assert "torch==1.2.3" in asked[-1]
        assert own_torch() not in asked[-1]

    def test_cuda_packages_are_refused_before_anything_is_downloaded(
        self, asked: list[str], requirements: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        pretend = making._uv

        def uv(arguments: Sequence[str]) -> str:
            pretend(arguments)
            return "Would install 2 packages\n + nvidia-cublas==13.0\n + torch==2.13.0\n"

        create(tmp_path / "env")
        monkeypatch.setattr(making, "_uv", uv)
        with pytest.raises(
            ConfigError, match=r"include CUDA packages \(nvidia-cublas==13.0, …\).*NAME.cpu.txt"
        ):
            make_environment(requirements, tmp_path / "env")
        assert len(asked) == 1
        assert "--dry-run" in asked[0]
        make_environment(requirements, tmp_path / "env", cuda=True)
        assert "--dry-run" not in asked[-1]


def test_with_a_gpu_nothing_is_replaced(
    asked: list[str], requirements: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(making, "has_gpu", lambda: True)
    monkeypatch.setattr(making, "driver_version", lambda: "580.65.06")
    (tmp_path / "some.cpu.txt").write_text("torchvision==0.1\n")
    make_environment(requirements, tmp_path / "env")
    assert len(asked) == 1
    assert "--override" not in asked[0]
    assert "--constraint" not in asked[0]


def test_torch_is_for_cuda_12_where_the_driver_is_too_old_for_13(
    asked: list[str], requirements: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(making, "has_gpu", lambda: True)
    monkeypatch.setattr(making, "driver_version", lambda: "570.124.06")
    said: list[str] = []
    make_environment(requirements, tmp_path / "env", progress=said.append)
    assert asked[-1].endswith("torch<2.11\n")
    assert (
        "the driver, 570.124.06, is older than 580, the first driver for CUDA 13: using torch<2.11"
        in said
    )
    monkeypatch.setenv("UV_TORCH_BACKEND", "cu126")
    make_environment(requirements, tmp_path / "env")
    assert "--constraint" not in asked[-1]


@pytest.mark.parametrize(
    ("files", "found"),
    [
        ([], False),
        (["dev/nvidiactl"], False),
        (["dev/nvidiactl", "dev/nvidia0"], True),
        (["dev/nvidia0", "etc/nv_tegra_release"], False),
        (["dev/dxg"], False),
        (["dev/dxg", "bin/nvidia-smi"], True),
    ],
)
def test_a_gpu_is_found_on_linux_and_wsl_and_none_on_a_jetson(
    files: list[str], found: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for file in map(tmp_path.joinpath, files):
        file.parent.mkdir(exist_ok=True)
        file.touch(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.setattr(making, "Path", lambda path: tmp_path / path.removeprefix("/"))
    assert making.has_gpu() is found


@pytest.mark.parametrize(
    ("file", "smi", "version"),
    [
        (
            "NVRM version: NVIDIA UNIX x86_64 Kernel Module  550.54.15  Tue Mar  5",
            "exit 9",
            "550.54.15",
        ),
        (
            "NVRM version: NVIDIA UNIX Open Kernel Module for x86_64  580.65.06  Release Build",
            "exit 9",
            "580.65.06",
        ),
        (None, "echo 576.02; echo 576.02", "576.02"),  # WSL2 with two GPUs
        (None, "exit 9", None),
        (None, None, None),
    ],
)
def test_the_driver_is_the_kernels_or_that_of_windows(
    file: str | None,
    smi: str | None,
    version: str | None,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setattr(accelerator, "_DRIVER", tmp_path / "version")
    monkeypatch.setenv("PATH", str(tmp_path))
    if file is not None:
        (tmp_path / "version").write_text(file)
    if smi is not None:
        (tmp_path / "nvidia-smi").write_text(f"#!/bin/sh\n{smi}\n")
        (tmp_path / "nvidia-smi").chmod(0o755)
    assert accelerator.driver_version() == version


def test_it_imports_torchvision_and_lerobot_as_fits_the_machine(
    asked: list[str], requirements: Path, tmp_path: Path
) -> None:
    python = make_environment(requirements, tmp_path / "env")
    code = "import sys; print(*(type(one).__module__ for one in sys.meta_path))"
    done = subprocess.run([str(python), "-c", code], capture_output=True, text=True, check=True)
    assert "vlagents_ray_import_fixes" in done.stdout
    assert not done.stderr


def test_missing_requirements_and_a_folder_of_something_else_are_refused(
    requirements: Path, tmp_path: Path
) -> None:
    with pytest.raises(
        ConfigError,
        match=r"expected a requirements file, got '/no/such\.txt', which does not exist",
    ):
        make_environment(Path("/no/such.txt"), tmp_path / "env")
    with pytest.raises(ConfigError, match="expected a new folder or a Python environment"):
        make_environment(requirements, tmp_path)


def test_what_uv_says_is_shown(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"(?s)uv venv failed:.*no-such-python"):
        create(tmp_path / "env", "no-such-python")


def test_uv_looks_where_pip_was_told_to(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in making._PIP_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    assert making._package_sources() == {}
    monkeypatch.setenv("PIP_FIND_LINKS", "/wheels /other")
    monkeypatch.setenv("PIP_INDEX_URL", "file:///simple")
    assert making._package_sources() == {
        "UV_FIND_LINKS": "/wheels,/other",
        "UV_DEFAULT_INDEX": "file:///simple",
    }


def test_without_uv_the_cure_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(making.importlib.util, "find_spec", lambda _: None)
    monkeypatch.setattr(making.shutil, "which", lambda *_, **__: None)
    cure = re.escape(f"'uv' is not installed; {pip_install('serve')}")
    with pytest.raises(MissingDependency, match=cure):
        create(tmp_path / "env")
