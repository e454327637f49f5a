"""`vlagents-ray keys`: the output of its commands, and the file of keys that they write."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from vlagents_ray import Forbidden, Unauthorized
from vlagents_ray.cli.main import app
from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray.serve.config.deployment import AccessArgs
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import _with_access


def keys(*words: str) -> Result:
    return CliRunner().invoke(app, ["keys", *words], env={"COLUMNS": "200"})


def test_a_key_is_printed_once_listed_without_it_and_revoked(tmp_path: Path) -> None:
    file = tmp_path / "keys.json"
    made = keys(
        "create",
        "arm",
        "--keys",
        str(file),
        "--app",
        "pi0",
        "--rate",
        "60",
        "--sessions",
        "2",
        "--days",
        "30",
    )
    assert made.exit_code == 0, made.output
    token = made.stdout.strip()  # only the key is printed, so that scripts can use the output
    assert Keys.from_file(file).check(token, "pi0").name == "arm"
    with pytest.raises(Forbidden):
        Keys.from_file(file).check(token, "noop")
    listed = keys("list", "--keys", str(file)).stdout
    for word in ("arm", "pi0", "60", "2", "until"):
        assert word in listed
    assert token not in listed
    assert keys("revoke", "arm", "--keys", str(file)).exit_code == 0
    assert "revoked" in keys("list", "--keys", str(file)).stdout
    with pytest.raises(Unauthorized):
        Keys.from_file(file).check(token, "pi0")


def test_a_key_may_push_weights_if_it_is_made_for_that(tmp_path: Path) -> None:
    file = tmp_path / "keys.json"
    tokens = [
        keys("create", *words, "--keys", str(file)).stdout.strip()
        for words in (["a", "--scope", "weights"], ["b"])
    ]
    learner, robot = (Keys.from_file(file).check(token, "pi0") for token in tokens)
    learner.require("weights")
    robot.take_request()
    with pytest.raises(Forbidden, match="expected the scope 'weights', which this key lacks"):
        robot.require("weights")
    assert "weights" in keys("list", "--keys", str(file)).stdout


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["create", "a b"], "letters"),
        (["create", "arm", "--priority", "king"], "robot"),
        (["create", "arm", "--scope", "root"], "weights"),
        (["create", "arm", "--rate", "-1"], "0.001"),
        (["revoke", "arm"], "keys create"),
    ],
)
def test_mistakes_are_told_in_a_line(words: list[str], text: str, tmp_path: Path) -> None:
    done = keys(*words, "--keys", str(tmp_path / "keys.json"))
    assert done.exit_code == 2, done.output
    assert text in " ".join(done.stderr.split())
    assert not (tmp_path / "keys.json").exists()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--host", "0.0.0.0"], "--insecure"),  # noqa: S104 - an address that is rejected
        (["--keys", "nowhere.json"], "keys create"),
        (["--tls-cert", "nowhere.pem"], "--tls-key"),
        (["--tls-cert", "nowhere.pem", "--tls-key", "nowhere.pem"], "PEM"),
        (["--insecure", "--keys", "nowhere.json"], "expected keys or insecure, got both"),
    ],
)
def test_a_server_that_would_not_be_safe_does_not_start(words: list[str], text: str) -> None:
    done = CliRunner().invoke(app, ["serve", "noop", *words])
    assert done.exit_code == 2, done.output
    assert text in done.stderr


@pytest.mark.parametrize(
    ("stated", "options", "found"),
    [
        ({}, (None, False, False), None),
        ({}, (Path("/k"), False, True), {"keys_file": "/k", "insecure": False, "plain_http": True}),
        (
            {"hosts": ["a.b"]},
            (None, True, False),
            {"hosts": ["a.b"], "keys_file": None, "insecure": True},
        ),
        ({"keys_file": "/k"}, (None, False, True), {"keys_file": "/k", "plain_http": True}),
        ({"insecure": True}, (Path("/k"), False, False), {"keys_file": "/k", "insecure": False}),
    ],
)
def test_the_command_line_overrules_what_the_file_says_of_keys_and_no_more(
    stated: dict[str, Any], options: tuple[Path | None, bool, bool], found: dict[str, Any] | None
) -> None:
    config = deployment("noop", **({"access": stated} if stated else {}))
    [app] = _with_access(config, *options).applications
    assert app.args.get("access") == found
    AccessArgs(**(found or {}))
