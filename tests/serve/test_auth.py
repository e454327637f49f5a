"""API keys: who is let in, how often, and that a change of the file counts."""

from __future__ import annotations

import hashlib
import json
import stat
import time
from pathlib import Path
from typing import Any

import pytest

from vlagents_ray.errors import ConfigError, Forbidden, TooManyRequests, Unauthorized
from vlagents_ray.serve import auth
from vlagents_ray.serve.auth import Keys, load_keys, require_access, token_of
from vlagents_ray.serve.keyfile import new_key, parse_keys, read_keys, revoke


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(auth, "_LOOK_S", 0.0)  # every check looks at the file
    return tmp_path / "keys.json"


def test_a_key_opens_its_applications_and_no_others(file: Path) -> None:
    token = new_key(file, "arm", apps=("pi0", "noop"))
    keys = Keys.from_file(file)
    assert keys.check(token, "pi0").name == "arm"
    with pytest.raises(Forbidden, match="noop"):
        keys.check(token, "other")


@pytest.mark.parametrize("wrong", [None, "", "wrong", "vlr_", "\udcff"])
def test_a_missing_or_wrong_key_opens_nothing(file: Path, wrong: str | None) -> None:
    token = new_key(file, "arm")
    with pytest.raises(Unauthorized):
        Keys.from_file(file).check(wrong, "noop")
    for changed in (token[:-1], token + "x", token.upper()):
        with pytest.raises(Unauthorized):
            Keys.from_file(file).check(changed, "noop")


def test_a_revoked_key_is_shut_out_while_it_is_in_use(file: Path) -> None:
    token, other = new_key(file, "arm"), new_key(file, "lab")
    keys = Keys.from_file(file)
    caller, bystander = keys.check(token, "noop"), keys.check(other, "noop")
    revoke(file, "arm")
    with pytest.raises(Unauthorized, match="revoked"):
        caller.admit()
    with pytest.raises(Unauthorized):
        keys.check(token, "noop")
    bystander.admit()


def test_a_key_made_anew_under_its_name_shuts_the_old_one_out(file: Path) -> None:
    old = new_key(file, "arm")
    keys = Keys.from_file(file)
    caller = keys.check(old, "noop")
    with pytest.raises(ConfigError, match="there already"):
        new_key(file, "arm")
    revoke(file, "arm")
    new = new_key(file, "arm")
    keys.check(new, "noop")
    with pytest.raises(Unauthorized):
        caller.admit()


def test_an_expired_key_is_shut_out(file: Path) -> None:
    token = new_key(file, "guest", expires=time.time() + 3600)
    caller = Keys.from_file(file).check(token, "noop")
    document = json.loads(file.read_text())
    document["keys"][0]["expires"] = time.time() - 1
    file.write_text(json.dumps(document))
    with pytest.raises(Unauthorized, match="expired"):
        caller.admit()


def test_nobody_is_let_in_once_the_file_is_gone(file: Path) -> None:
    token = new_key(file, "arm")
    keys = Keys.from_file(file)
    file.unlink()
    with pytest.raises(Unauthorized):
        keys.check(token, "noop")


def test_a_broken_file_changes_nothing_until_it_is_mended(file: Path) -> None:
    token = new_key(file, "arm")
    keys = Keys.from_file(file)
    good = file.read_text()
    file.write_text(good[:-10])
    keys.check(token, "noop")
    file.write_text(good)
    revoke(file, "arm")
    with pytest.raises(Unauthorized):
        keys.check(token, "noop")


def test_a_rate_is_kept_by_name_over_all_connections(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0
    monkeypatch.setattr(auth.time, "monotonic", lambda: now)
    token = new_key(file, "arm", rate=4)
    keys = Keys.from_file(file)
    callers = [keys.check(token, "noop") for _ in range(4)]
    for caller in callers:
        caller.admit()
    with pytest.raises(TooManyRequests) as refused:
        callers[0].admit()
    assert refused.value.retry_after_s == pytest.approx(0.25)
    callers[0].admit(free=True)
    now += 0.25
    callers[1].admit()
    with pytest.raises(TooManyRequests):
        callers[2].admit()


def test_the_file_holds_hashes_for_its_owner_alone(file: Path) -> None:
    token = new_key(file, "arm", rank="simulation", sessions=3)
    assert token not in file.read_text()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    (key,) = read_keys(file)
    assert key.sha256 == hashlib.sha256(token.encode()).hexdigest()
    assert (key.rank, key.sessions) == ("simulation", 3)
    assert list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize(
    ("entry", "word"),
    [
        ({}, "name"),
        ({"name": "a b"}, "letters"),
        ({"name": "a/b"}, "letters"),
        ({"sha256": "12"}, "hexadecimal"),
        ({"rate": 0}, "positive"),
        ({"rate": True}, "positive"),
        ({"sessions": 1.5}, "positive"),
        ({"rank": "king"}, "robot"),
        ({"apps": "pi0"}, "list"),
        ({"revoked": 1}, "true or false"),
        ({"ratee": 1}, "ratee"),
    ],
)
def test_a_wrong_entry_is_named(entry: dict[str, Any], word: str) -> None:
    whole = {"name": "a", "sha256": "0" * 64, **entry} if entry else {}
    with pytest.raises(ConfigError, match=word):
        parse_keys(json.dumps({"keys": [whole]}))


def test_two_keys_of_one_name_are_refused() -> None:
    one = {"name": "a", "sha256": "0" * 64}
    with pytest.raises(ConfigError, match="more than once"):
        parse_keys(json.dumps({"keys": [one, one]}))


def test_keys_come_from_a_file_or_the_environment(file: Path) -> None:
    token = new_key(file, "arm")
    for keys in (
        load_keys(str(file), {}),
        load_keys(None, {auth.FILE_VARIABLE: str(file)}),
        load_keys(None, {auth.TEXT_VARIABLE: file.read_text()}),
    ):
        assert keys is not None
        keys.check(token, "noop")
    assert load_keys(None, {}) is None
    with pytest.raises(ConfigError, match="keys new"):
        load_keys(str(file.with_name("none.json")), {})


@pytest.mark.parametrize(
    ("headers", "token"),
    [
        ({"authorization": "Bearer k"}, "k"),
        ({"authorization": "bearer  k "}, "k"),
        ({"authorization": "Api-Key k"}, "k"),
        ({"x-api-key": "k"}, "k"),
        ({"authorization": "Basic k"}, None),
        ({"authorization": "Bearer"}, None),
        ({"authorization": "k"}, None),
        ({"x-api-key": ""}, None),
        ({}, None),
    ],
)
def test_a_key_comes_in_three_headers(headers: dict[str, str], token: str | None) -> None:
    assert token_of(headers) == token


def test_off_loopback_somebody_must_have_decided_who_is_let_in(file: Path) -> None:
    new_key(file, "arm")
    for host in ("127.0.0.1", "127.0.0.2", "localhost", "::1"):
        require_access(host, None, insecure=False)
    for host in ("0.0.0.0", "192.0.2.1", "::", "", "127.example.org"):  # noqa: S104 - what is refused
        with pytest.raises(ConfigError, match="--insecure"):
            require_access(host, None, insecure=False)
        require_access(host, Keys.from_file(file), insecure=False)
        require_access(host, None, insecure=True)
