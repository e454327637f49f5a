"""The results of `vlagents-ray doctor` on a machine, and the cures that it names."""

from __future__ import annotations

import importlib.metadata
import io
import json
import os
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import pytest
from rich.console import Console

from vlagents_ray.cli import doctor
from vlagents_ray.cli.doctor import Check
from vlagents_ray.envs import graphics
from vlagents_ray.envs.graphics import EglDevice
from vlagents_ray.errors import MissingDependency
from vlagents_ray.serve.ports import free_port

GB = doctor.GB


def nvidia_smi(folder: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    tool = folder / "nvidia-smi"
    tool.write_text(f"#!/bin/sh\n{script}\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder), prepend=os.pathsep)


def table(monkeypatch: pytest.MonkeyPatch, *rows: Check) -> tuple[int, str]:
    monkeypatch.setattr(
        doctor, "checks", lambda *_: ((f"row {i}", row) for i, row in enumerate(rows))
    )
    text = io.StringIO()
    code = doctor.run(Console(file=text, width=200))
    return code, text.getvalue()


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.sim
@pytest.mark.torch
def test_every_check_gives_a_row_of_its_own_and_none_breaks() -> None:
    named_rows = list(doctor.checks(port=0))
    rows = [row for _, row in named_rows]
    names = [name for name, _ in named_rows]
    for expected in (
        "Python",
        "Ray",
        "plug-ins",
        "HAProxy",
        "GPU",
        "Vulkan",
        "EGL",
        "shared memory",
        "open files",
    ):
        assert names.count(expected) == 1
    assert [row for row in rows if "the check itself broke" in row.detail] == []
    assert [row for row in rows if row.status != "ok" and not row.cure] == []
    # The program of the check examines this Python.
    assert dict(named_rows)["torch"].detail.startswith(importlib.metadata.version("torch"))


def test_the_table_shows_findings_as_written_and_its_exit_code_is_1_only_if_a_check_failed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fine, slow = Check("ok", "x"), Check("warn", "x", "y")
    broken = Check("fail", "not [red]here", "pip install 'vlagents-ray[serve]'")
    assert table(monkeypatch, fine, slow)[0] == 0
    code, text = table(monkeypatch, fine, broken, slow)
    assert code == 1
    assert broken.detail in text
    assert broken.cure in text


def test_a_check_that_raises_becomes_a_row_with_its_cure_if_there_is_one() -> None:
    def raising(error: Exception) -> Callable[[], Check]:
        return Mock(side_effect=error)

    row = doctor.guarded(raising(ZeroDivisionError("driver")))
    assert row.status == "warn"
    assert "ZeroDivisionError: driver" in row.detail
    missing = MissingDependency("'av' is not installed; pip install 'vlagents-ray[sim]'")
    assert doctor.guarded(raising(missing)) == Check(
        "warn", "'av' is not installed", "pip install 'vlagents-ray[sim]'"
    )


def test_another_ray_than_those_that_are_tested_is_a_warning(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert doctor.ray().status == "ok"
    monkeypatch.setattr(
        "importlib.metadata.requires",
        lambda _: ["numpy", 'ray[serve]<2.61,>=2.60; extra == "serve"'],
    )
    for version in ("2.60.0", "2.60.1"):
        monkeypatch.setattr("importlib.metadata.version", lambda _, version=version: version)
        assert doctor.ray().status == "ok"
    monkeypatch.setattr("importlib.metadata.version", lambda _: "2.1.0")
    row = doctor.ray()
    assert row.status == "warn"
    assert row.detail == "2.1.0; this package is tested with <2.61,>=2.60"


def test_haproxy_really_starts() -> None:
    assert doctor.haproxy().status == "ok"


def test_an_haproxy_that_does_not_start_is_a_warning(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    binary = tmp_path / "haproxy"
    binary.write_text("#!/bin/sh\necho 'no libssl' >&2; exit 127\n")
    binary.chmod(0o755)
    monkeypatch.setenv("RAY_SERVE_HAPROXY_BINARY_PATH", str(binary))
    row = doctor.haproxy()
    assert row.status == "warn"
    assert "no libssl" in row.detail


def test_no_gpu_or_one_that_its_driver_lost_is_a_warning(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert doctor.gpu().status == "warn"
    monkeypatch.undo()
    nvidia_smi(tmp_path, monkeypatch, "echo 'Driver/library version mismatch'; exit 18")
    row = doctor.gpu()
    assert row.status == "warn"
    assert "Driver/library version mismatch" in row.detail


TORCH = {
    "version": "2.13.0",
    "cuda": "13.0",
    "device": None,
    "why": "error 802: system not yet initialized",
}
JAX = {"version": "0.5.3", "cuda": "12", "device": None, "why": "no platforms are present"}


@pytest.mark.parametrize(
    ("name", "found", "driver", "status", "said", "cure"),
    [
        (
            "torch",
            TORCH | {"device": "NVIDIA H100"},
            "580.65.06",
            "ok",
            ("2.13.0, for CUDA 13.0, uses NVIDIA H100"),
            "",
        ),
        ("torch", TORCH, "580.65.06", "warn", "cannot use the GPU: error 802", "dmesg"),
        (
            "torch",
            TORCH,
            "570.124.06",
            "warn",
            "expected driver 580 or newer, got 570.124.06",
            "venv create",
        ),
        ("torch", TORCH | {"cuda": "12.8"}, "570.124.06", "warn", "cannot use the GPU", "dmesg"),
        (
            "torch",
            TORCH | {"cuda": None},
            "580.65.06",
            "warn",
            "for CPUs only",
            "--force-reinstall torch",
        ),
        ("torch", TORCH | {"cuda": None}, None, "ok", "for CPUs only; no GPU here", ""),
        (
            "jax",
            JAX | {"device": "NVIDIA H100"},
            "535.1",
            "ok",
            ("0.5.3, for CUDA 12, uses NVIDIA H100"),
            "",
        ),
        (
            "jax",
            JAX,
            "470.1",
            "warn",
            "expected driver 525 or newer, got 470.1",
            "update the driver",
        ),
        ("jax", JAX | {"cuda": None}, "535.1", "warn", "for CPUs only", "'jax[cuda12]==0.5.3'"),
    ],
)
def test_a_library_counts_only_if_it_can_use_the_gpu(
    name: str, found: dict[str, str], driver: str | None, status: str, said: str, cure: str
) -> None:
    row = doctor.judge_library(name, driver, **found)
    assert row.status == status
    assert said in row.detail
    assert cure in row.cure
    assert bool(cure) is (status == "warn")


class TestAPolicysPython:
    @pytest.fixture(autouse=True)
    def old_driver(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(doctor, "has_gpu", lambda: True)
        monkeypatch.setattr(doctor, "driver_version", lambda: "570.1")

    def interpreter(self, folder: str, says: str) -> Path:
        """Write a Python interpreter that prints `says` instead of running."""
        python = Path(folder) / "bin" / "python"
        python.parent.mkdir(parents=True)
        python.write_text(f"#!/bin/sh\n{says}\n")
        python.chmod(0o755)
        return python

    def test_is_one_that_venv_create_made_here_unless_others_are_named(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        self.interpreter(
            ".venv-hf", f"echo '{json.dumps({'headers': '/none', 'libraries': {'torch': TORCH}})}'"
        )
        other = self.interpreter(
            "other",
            "echo 'a warning'; echo "
            f"'{json.dumps({'headers': '/none', 'libraries': {'jax': JAX}})}'",
        )
        this = self.interpreter(
            "this", f"echo '{json.dumps({'headers': '/none', 'libraries': {}})}'"
        )
        monkeypatch.setattr(sys, "executable", str(this))
        monkeypatch.setattr(doctor, "guarded", lambda _: Check("ok", ""))
        found = dict(doctor.checks())
        assert "expected driver 580 or newer, got 570.1" in found["torch in .venv-hf"].detail
        assert found["C compiler for Triton in .venv-hf"].status == "warn"
        assert not [name for name in found if "other" in name]
        named = dict(doctor.checks(pythons=[other]))
        assert "cannot use the GPU: no platforms are present" in named["jax in other"].detail
        assert not [name for name in named if "Triton" in name or ".venv-hf" in name]

    def test_that_does_not_run_is_a_row(self) -> None:
        broken = self.interpreter(".venv-hf", "echo 'no libpython' >&2; exit 127")
        for python, said in ((broken, "no libpython"), (Path("/none/bin/python"), "No such file")):
            [(_, row)] = doctor.libraries(python)
            assert row.status == "warn"
            assert said in row.detail


@pytest.mark.parametrize(
    ("tools", "headers", "detail"),
    [
        (["gcc", "clang"], True, "gcc"),
        (["clang"], True, "clang"),
        (["gcc"], False, "no "),
        ([], True, "none; torch.compile needs a compiler on a GPU"),
    ],
)
def test_triton_needs_a_compiler_and_pythons_headers(
    tools: list[str], headers: bool, detail: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    for tool in tools:
        (tmp_path / tool).touch(0o755)
    if headers:
        (tmp_path / "Python.h").touch()
    row = doctor.triton_compiler(tmp_path)
    assert detail in row.detail
    assert (row.status == "ok") is (headers and bool(tools))


@pytest.mark.parametrize(("software", "status"), [(True, "ok"), (False, "warn")])
def test_a_machine_on_which_workers_without_a_gpu_could_not_render_is_told(
    monkeypatch: pytest.MonkeyPatch, software: bool, status: str
) -> None:
    devices = (
        EglDevice(0, software=False, cuda=0),
        *([EglDevice(1, software=True, cuda=None)] if software else []),
    )
    found = graphics.RenderProbe(
        ok=True, seconds=1.0, device="NVIDIA H200/PCIe/SSE2", devices=devices
    )
    monkeypatch.setattr(graphics, "egl_probe", lambda: found)
    row = doctor.egl()
    assert row.status == status
    assert ("gpus: 0.25" in row.cure) is not software


@pytest.mark.parametrize(
    ("judged", "status", "said"),
    [
        (doctor.judge_shared_memory(total=32 * GB, free=30 * GB, memory=64 * GB), "ok", ""),
        (
            doctor.judge_shared_memory(total=0.064 * GB, free=0.064 * GB, memory=16 * GB),
            "warn",
            "--shm-size=5g",
        ),
        # Ray limits the size of its store.
        (doctor.judge_shared_memory(total=100 * GB, free=100 * GB, memory=1000 * GB), "ok", ""),
        (doctor.judge_temp_dir("/tmp", total=1000 * GB, free=0.5 * GB), "fail", ""),
        (doctor.judge_temp_dir("/tmp", total=1000 * GB, free=3 * GB), "warn", ""),
        (doctor.judge_temp_dir("/tmp", total=1000 * GB, free=20 * GB), "warn", ""),
        (doctor.judge_temp_dir("/tmp", total=1000 * GB, free=200 * GB), "ok", ""),
        # The name of a socket may have 107 bytes.
        (doctor.judge_temp_dir("/tmp/" + "x" * 60, total=100 * GB, free=90 * GB), "fail", "107"),
        (doctor.judge_open_files(1024, 1024), "warn", ""),
        (doctor.judge_open_files(1024, 1_048_576), "ok", ""),  # Ray raises the soft limit
        (doctor.judge_open_files(65536, 65536), "ok", ""),
    ],
)
def test_what_a_machine_has_is_judged_by_what_ray_will_need(
    judged: Check, status: str, said: str
) -> None:
    assert judged.status == status
    assert said in judged.detail + judged.cure


def test_rays_temporary_folder_is_the_one_that_is_judged(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path / "missing"))
    row = doctor.temp_dir()
    assert row.status == "fail"
    assert "missing" in row.detail


def test_a_taken_port_has_another_one_as_cure() -> None:
    port = free_port()  # no other process takes this port in the meantime
    with socket.create_server(("127.0.0.1", port)):
        row = doctor.port_free(port)
    assert (row.status, row.detail) == ("warn", "taken")
    assert f"--port {port + 1}" in row.cure
    assert doctor.port_free(port).status == "ok"


def test_a_containers_memory_limit_is_what_counts(tmp_path: Path) -> None:
    machines = doctor.memory_bytes(tmp_path / "none")
    limit = tmp_path / "memory.max"
    limit.write_text("1000000\n")
    assert doctor.memory_bytes(limit) == 1_000_000
    limit.write_text("max\n")
    assert doctor.memory_bytes(limit) == machines


@pytest.mark.parametrize(
    ("version", "status"), [((3, 10), "warn"), ((3, 11), "ok"), ((3, 12), "warn")]
)
def test_a_python_that_is_not_supported_for_servers_is_a_warning(
    version: tuple[int, int], status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.version_info", (*version, 1))
    check = doctor.python_version()
    assert check.status == status
    assert (status == "ok") == ("3.11" not in check.cure)
    root = Path(doctor.__file__).parents[2]
    sentences = {
        "README.md": "You need Linux, Python 3.11",
        "docs/install.md": "supported on Linux with Python 3.11",
    }
    for page, sentence in sentences.items():
        assert sentence in " ".join((root / page).read_text().split())
