"""`vlagents-ray report`: folders in, one page out."""

from __future__ import annotations

from pathlib import Path

import pytest
from recorded_results import record, runs
from typer.testing import CliRunner, Result

from vlagents_ray.cli.main import app


def report(*words: str) -> Result:
    return CliRunner().invoke(app, ["report", *words], env={"COLUMNS": "200"})


def test_the_page_stands_beside_the_results(tmp_path: Path) -> None:
    record(runs(tmp_path))
    done = report(str(tmp_path))
    assert done.exit_code == 0, done.output
    assert done.stdout.strip() == f"report: {tmp_path / 'report.html'}"
    assert (tmp_path / "report.html").read_text().startswith("<!doctype html>")


def test_several_folders_make_one_page_where_it_is_wanted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b"):
        policies = [{"name": name, "url": "http://localhost:1"}]
        record(runs(tmp_path / name, policies=policies), videos=True)
    words = [str(tmp_path / "a"), str(tmp_path / "b"), "--videos", "inline"]
    assert report(*words, "--html", str(tmp_path / "pages" / "both.html")).exit_code == 0
    page = (tmp_path / "pages" / "both.html").read_text()
    assert "data:video/mp4;base64," in page
    assert page.count("<title>Episodes solved by each step</title>") == 1
    monkeypatch.chdir(tmp_path)
    assert report(*words).exit_code == 0
    assert (tmp_path / "report.html").is_file()


def test_a_folder_without_results_is_refused(tmp_path: Path) -> None:
    done = report(str(tmp_path))
    assert done.exit_code == 2
    assert "want a folder that an evaluation wrote its results to" in done.stderr
