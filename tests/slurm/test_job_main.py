"""What a job's first node finds out."""

from __future__ import annotations

import datetime
import os
from pathlib import Path

import pytest

from vlagents_ray.slurm.job import end_of_job


def squeue_says(text: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = folder / "squeue"
    file.write_text(f"#!/bin/bash\necho '{text}'\n")
    file.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")


def test_the_end_of_a_job_is_slurms_local_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    squeue_says("2027-01-31T18:30:00", tmp_path, monkeypatch)
    assert end_of_job(1) == datetime.datetime(2027, 1, 31, 18, 30).timestamp()


def test_a_job_without_a_limit_has_no_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    squeue_says("NONE", tmp_path, monkeypatch)
    assert end_of_job(1) is None


def test_a_newer_slurm_has_said_it_by_a_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SLURM_JOB_END_TIME", "1801500000")
    assert end_of_job(1) == 1801500000.0
