"""`vlagents-ray report` makes one page from one or more folders."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from eval_fakes import wait_for
from live_server import LivePage
from recorded_results import record, runs
from typer.testing import CliRunner, Result

from vlagents_ray.cli.main import app


def report(*words: str) -> Result:
    return CliRunner().invoke(app, ["report", *words], env={"COLUMNS": "200"})


@pytest.mark.slow
def test_a_page_stands_beside_its_results_and_one_of_several_folders_where_it_is_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b"):
        policies = [{"name": name, "url": "http://localhost:1"}]
        record(runs(tmp_path / name, policies=policies), videos=True)
    done = report(str(tmp_path / "a"))
    assert done.exit_code == 0, done.output
    assert done.stdout.strip() == f"report: {tmp_path / 'a' / 'report.html'}"
    assert (tmp_path / "a" / "report.html").read_text().startswith("<!doctype html>")
    (tmp_path / "pages").mkdir()
    words = [str(tmp_path / "a"), str(tmp_path / "b"), "--inline"]
    assert report(*words, "--out", str(tmp_path / "pages" / "both.html")).exit_code == 0
    page = (tmp_path / "pages" / "both.html").read_text()
    assert "data:video/mp4;base64," in page
    assert page.count('id="success"') == 1
    monkeypatch.chdir(tmp_path)
    assert report(*words).exit_code == 0
    assert (tmp_path / "report.html").is_file()


@pytest.mark.slow
def test_results_that_another_process_writes_are_watched_until_ctrl_c(tmp_path: Path) -> None:
    record(runs(tmp_path / "out", episodes=2))
    page = LivePage()
    command = [
        Path(sys.executable).parent / "vlagents-ray",
        "report",
        tmp_path / "out",
        "--live-at",
        page.address,
    ]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as watching:
        wait_for(lambda: page.evaluation() or watching.poll() is not None)
        said = page.evaluation()
        watching.send_signal(signal.SIGINT)
        printed, _ = watching.communicate(timeout=60)
    assert (watching.returncode, printed) == (0, f"live: {page.url}/live\n")
    assert (said["state"], said["done"], len(said["cases"])) == ("complete", 18, 9)
    assert not (tmp_path / "out" / "report.html").exists()


def test_what_is_no_folder_of_results_or_more_than_one_to_watch_is_refused(tmp_path: Path) -> None:
    done = report(str(tmp_path))
    assert done.exit_code == 2
    assert "expected a folder that an evaluation wrote" in done.stderr
    assert "expected one FOLDER" in report(str(tmp_path), str(tmp_path), "--live").stderr
