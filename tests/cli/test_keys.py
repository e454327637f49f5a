"""`vlagents-ray keys`: what it prints, and what it leaves in the file."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from vlagents_ray import Forbidden, Unauthorized
from vlagents_ray.cli.main import app
from vlagents_ray.serve.auth import Keys


def keys(*words: str) -> Result:
    return CliRunner().invoke(app, ["keys", *words], env={"COLUMNS": "200"})


def test_a_key_is_printed_once_listed_without_it_and_revoked(tmp_path: Path) -> None:
    file = tmp_path / "keys.json"
    made = keys("new", "arm", "--file", str(file), "--app", "pi0", "--rate", "60", "--sessions", "2", "--days", "30")
    assert made.exit_code == 0, made.output
    token = made.stdout.strip()  # nothing else, so that a script can take it
    assert Keys.from_file(file).check(token, "pi0").name == "arm"
    with pytest.raises(Forbidden):
        Keys.from_file(file).check(token, "noop")
    listed = keys("list", "--file", str(file)).stdout
    for word in ("arm", "pi0", "60", "2", "until"):
        assert word in listed
    assert token not in listed
    assert keys("revoke", "arm", "--file", str(file)).exit_code == 0
    assert "revoked" in keys("list", "--file", str(file)).stdout
    with pytest.raises(Unauthorized):
        Keys.from_file(file).check(token, "pi0")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["new", "a b"], "letters"),
        (["new", "arm", "--rank", "king"], "robot"),
        (["new", "arm", "--rate", "-1"], "positive"),
        (["revoke", "arm"], "keys new"),
        (["list"], "keys new"),
    ],
)
def test_mistakes_are_told_in_a_line(words: list[str], text: str, tmp_path: Path) -> None:
    done = keys(*words, "--file", str(tmp_path / "keys.json"))
    assert done.exit_code == 2, done.output
    assert text in " ".join(done.stderr.split())
    assert not (tmp_path / "keys.json").exists()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--host", "0.0.0.0"], "--insecure"),  # noqa: S104 - what is refused
        (["--keys", "nowhere.json"], "keys new"),
        (["--tls-cert", "nowhere.pem"], "--tls-key"),
        (["--tls-cert", "nowhere.pem", "--tls-key", "nowhere.pem"], "PEM"),
        (["--insecure", "--keys", "nowhere.json"], "exclude each other"),
    ],
)
def test_a_server_that_would_not_be_safe_does_not_start(words: list[str], text: str) -> None:
    done = CliRunner().invoke(app, ["serve", "noop", *words])
    assert done.exit_code == 2, done.output
    assert text in done.stderr
