"""What `vlagents-ray doctor` finds on a machine, and the cures that it names."""

from __future__ import annotations

import io
import os
import socket
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import pytest
from rich.console import Console

from vlagents_ray.cli import doctor
from vlagents_ray.cli.doctor import Check
from vlagents_ray.envs import render_probe
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
    monkeypatch.setattr(doctor, "checks", lambda _: ((f"row {i}", row) for i, row in enumerate(rows)))
    text = io.StringIO()
    code = doctor.run(Console(file=text, width=200))
    return code, text.getvalue()


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.sim
def test_every_check_gives_a_row_of_its_own_and_none_breaks() -> None:
    found = list(doctor.checks(port=0))
    rows = [row for _, row in found]
    names = [name for name, _ in found]
    for expected in ("Python", "Ray", "HAProxy", "GPU", "Vulkan", "EGL", "shared memory", "open files"):
        assert names.count(expected) == 1
    assert [row for row in rows if "the check itself broke" in row.detail] == []
    assert [row for row in rows if row.status != "ok" and not row.cure] == []


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
    assert doctor.guarded(raising(missing)) == Check("warn", "'av' is not installed", "pip install 'vlagents-ray[sim]'")


def test_another_ray_than_those_that_are_tested_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.ray().status == "ok"
    monkeypatch.setattr("importlib.metadata.requires", lambda _: ["numpy", 'ray[serve]<2.61,>=2.60; extra == "serve"'])
    for version in ("2.60.0", "2.60.1"):
        monkeypatch.setattr("importlib.metadata.version", lambda _, version=version: version)
        assert doctor.ray().status == "ok"
    monkeypatch.setattr("importlib.metadata.version", lambda _: "2.1.0")
    row = doctor.ray()
    assert row.status == "warn"
    assert row.detail == "2.1.0; this package is tested with <2.61,>=2.60"


def test_haproxy_really_starts() -> None:
    assert doctor.haproxy().status == "ok"


def test_an_haproxy_that_does_not_start_is_a_warning(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    binary = tmp_path / "haproxy"
    binary.write_text("#!/bin/sh\necho 'no libssl' >&2; exit 127\n")
    binary.chmod(0o755)
    monkeypatch.setenv("RAY_SERVE_HAPROXY_BINARY_PATH", str(binary))
    row = doctor.haproxy()
    assert row.status == "warn"
    assert "no libssl" in row.detail


def test_no_gpu_or_one_that_its_driver_lost_is_a_warning(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert doctor.gpu().status == "warn"
    monkeypatch.undo()
    nvidia_smi(tmp_path, monkeypatch, "echo 'Driver/library version mismatch'; exit 18")
    row = doctor.gpu()
    assert row.status == "warn"
    assert "Driver/library version mismatch" in row.detail


@pytest.mark.parametrize(
    ("torch", "status", "said"),
    [
        ("2.13.0|13.0|True", "ok", "torch 2.13.0 uses it"),
        ("2.13.0+cpu|None|False", "warn", "CPU-only"),
        ("2.13.0|13.0|False", "warn", "cannot use it"),
    ],
)
def test_a_gpu_counts_only_if_torch_can_use_it(
    torch: str, status: str, said: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    nvidia_smi(tmp_path, monkeypatch, "echo 'NVIDIA H200, 143771 MiB, 580.1'")
    monkeypatch.setattr(doctor, "_TORCH_CUDA", f"print({torch!r})")
    row = doctor.gpu()
    assert row.status == status
    assert "NVIDIA H200, 143771 MiB, 580.1" in row.detail
    assert said in row.detail


@pytest.mark.parametrize(("software", "status"), [(True, "ok"), (False, "warn")])
def test_a_machine_on_which_workers_without_a_gpu_could_not_render_is_told(
    monkeypatch: pytest.MonkeyPatch, software: bool, status: str
) -> None:
    devices = (EglDevice(0, software=False, cuda=0), *([EglDevice(1, software=True, cuda=None)] if software else []))
    found = render_probe.RenderProbe("egl", ok=True, seconds=1.0, device="NVIDIA H200/PCIe/SSE2", devices=devices)
    monkeypatch.setattr(render_probe, "egl_probe", lambda: found)
    row = doctor.egl()
    assert row.status == status
    assert ("gpus: 0.25" in row.cure) is not software


@pytest.mark.parametrize(
    ("judged", "status", "said"),
    [
        (doctor.python((3, 9, 18)), "fail", ""),
        (doctor.python((3, 10, 0)), "ok", ""),
        (doctor.judge_shared_memory(total=32 * GB, free=30 * GB, memory=64 * GB), "ok", ""),
        (doctor.judge_shared_memory(total=0.064 * GB, free=0.064 * GB, memory=16 * GB), "warn", "--shm-size=5g"),
        (doctor.judge_shared_memory(total=100 * GB, free=100 * GB, memory=1000 * GB), "ok", ""),  # Ray caps its store
        (doctor.judge_temp_dir("/tmp", total=1000 * GB, free=0.5 * GB), "fail", ""),
        (doctor.judge_temp_dir("/tmp", total=1000 * GB, free=3 * GB), "warn", ""),
        (doctor.judge_temp_dir("/tmp", total=1000 * GB, free=20 * GB), "warn", ""),
        (doctor.judge_temp_dir("/tmp", total=1000 * GB, free=200 * GB), "ok", ""),
        (doctor.judge_temp_dir("/tmp/" + "x" * 60, total=100 * GB, free=90 * GB), "fail", "107"),  # bytes of a socket
        (doctor.judge_open_files(1024, 1024), "warn", ""),
        (doctor.judge_open_files(1024, 1_048_576), "ok", ""),  # as Ray raises them
        (doctor.judge_open_files(65536, 65536), "ok", ""),
    ],
)
def test_what_a_machine_has_is_judged_by_what_ray_will_need(judged: Check, status: str, said: str) -> None:
    assert judged.status == status
    assert said in judged.detail + judged.cure


def test_rays_temporary_folder_is_the_one_that_is_judged(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path / "missing"))
    row = doctor.temp_dir()
    assert row.status == "fail"
    assert "missing" in row.detail


def test_a_taken_port_has_another_one_as_cure() -> None:
    port = free_port()  # no other process takes it meanwhile
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
