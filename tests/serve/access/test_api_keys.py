"""API keys: which clients are accepted, at which rate, and how a change of the file takes
effect.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import logging
import os
import queue
import stat
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from eval_fakes import wait_for
from in_flight import Calls, ignore, send

from vlagents_ray import Obs
from vlagents_ray.errors import (
    ConfigError,
    Forbidden,
    NoReplica,
    TooManyRequests,
    Unauthorized,
)
from vlagents_ray.policies.noop import Noop
from vlagents_ray.protocol.frames import Decoded, decode_requests, encode_requests
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Reply, Request
from vlagents_ray.serve.access import api_keys, audit, key_store
from vlagents_ray.serve.access.api_keys import (
    Keys,
    NoKey,
    load_keys,
    require_access,
    token_of,
)
from vlagents_ray.serve.access.charges import Account, free
from vlagents_ray.serve.access.key_store import (
    new_key,
    parse_keys,
    read_keys,
    revoke,
)
from vlagents_ray.serve.access.variables import FILE_VARIABLE
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender, message_admission
from vlagents_ray.serve.requests import IncomingMessage


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(api_keys, "_CHECK_S", 0.0)  # the file is checked at each request
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
        caller.take_request()
    with pytest.raises(Unauthorized):
        keys.check(token, "noop")
    bystander.take_request()


def test_a_key_made_anew_under_its_name_shuts_the_old_one_out(file: Path) -> None:
    old = new_key(file, "arm")
    keys = Keys.from_file(file)
    caller = keys.check(old, "noop")
    with pytest.raises(ConfigError, match="exists already"):
        new_key(file, "arm")
    revoke(file, "arm")
    new = new_key(file, "arm")
    keys.check(new, "noop")
    with pytest.raises(Unauthorized):
        caller.take_request()


def test_an_expired_key_is_shut_out(file: Path) -> None:
    token = new_key(file, "guest", expires=time.time() + 3600)
    caller = Keys.from_file(file).check(token, "noop")
    document = json.loads(file.read_text())
    document["keys"][0]["expires"] = time.time() - 1
    file.write_text(json.dumps(document))
    with pytest.raises(Unauthorized, match="expired"):
        caller.take_request()


def test_nobody_is_let_in_once_the_file_is_gone(file: Path) -> None:
    token = new_key(file, "arm")
    keys = Keys.from_file(file)
    file.unlink()
    with pytest.raises(Unauthorized):
        keys.check(token, "noop")


NONSENSE = {
    "not UTF-8": b'{"keys": [], "note": "\xff"}',
    "not JSON": b"{",
    "empty": b"",
    "too deep": b"[" * 100_000,
    "a list": b"[]",
    "no list": b'{"keys": 3}',
    "no objects": b'{"keys": [3]}',
    "a number for a hash": b'{"keys": [{"name": "a", "sha256": 3}]}',
    "a list for a name": b'{"keys": [{"name": ["a"], "sha256": "00"}]}',
    "no number": b'{"keys": [{"name": "a", "sha256": "%s", "rate": NaN}]}' % (b"0" * 64),
    "a huge number": b'{"keys": [{"name": "a", "sha256": "%s", "expires": 1%s}]}'
    % (b"0" * 64, b"0" * 400),
    "huge digits": b'{"keys": [%s]}' % (b"9" * 10_000),
    "zeros": bytes(1000),
}


@pytest.mark.parametrize("text", NONSENSE.values(), ids=NONSENSE.keys())
def test_no_nonsense_in_the_file_gets_out_and_before_long_nobody_gets_in(
    file: Path, text: bytes, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    now = 1000.0
    monkeypatch.setattr(api_keys.time, "monotonic", lambda: now)
    token = new_key(file, "arm")
    keys = Keys.from_file(file)
    good = file.read_bytes()
    caller = keys.check(token, "noop")
    assert keys.unreadable_s == 0
    file.write_bytes(text)
    with pytest.raises(ConfigError):
        Keys.from_file(file)
    caller.take_request()
    assert "the current keys stay valid for 300 s more" in caplog.text
    now += api_keys._CLOSE_S - 1
    keys.check(token, "noop").take_request()
    assert keys.unreadable_s == api_keys._CLOSE_S - 1
    now += 2
    assert caller.refusal() is not None
    with pytest.raises(Unauthorized):
        keys.check(token, "noop")
    assert "all keys are rejected, as no key file could be read for 300 s" in caplog.text
    file.write_bytes(good)
    keys.check(token, "noop")
    assert keys.unreadable_s == 0
    caller.take_request()


def test_a_network_drive_that_hangs_delays_one_request_and_closes_the_server_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now, asked, answers = 1000.0, 0, threading.Event()
    answers.set()
    monkeypatch.setattr(api_keys.time, "monotonic", lambda: now)
    monkeypatch.setattr(api_keys, "_CHECK_S", 0.0)

    def changed() -> object:
        nonlocal asked
        asked += 1
        answers.wait()
        return asked

    keys = Keys(
        lambda: json.dumps({"keys": [{"name": "arm", "sha256": hashlib.sha256(b"k").hexdigest()}]}),
        changed,
    )
    caller = keys.check("k", "noop")
    answers.clear()
    monkeypatch.setattr(api_keys, "_WAIT_S", 0.01)
    caller.take_request()
    before = asked
    monkeypatch.setattr(api_keys, "_WAIT_S", 3600.0)
    for _ in range(3):
        now += 100
        caller.take_request()
    assert asked == before
    assert keys.unreadable_s == 200
    now += 101
    with pytest.raises(Unauthorized):
        caller.take_request()
    answers.set()
    wait_for(lambda: keys.key(hashlib.sha256(b"k").digest()) is not None)
    caller.take_request()
    assert keys.unreadable_s == 0


@pytest.mark.parametrize(
    "error", [PermissionError("no"), OSError("stale file handle"), RuntimeError("whatever")]
)
@pytest.mark.parametrize("at", ["read", "changed"])
def test_a_file_that_cannot_be_read_any_more_closes_the_server(
    error: Exception, at: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading fails if the file's owner or mode has changed, its folder is gone, or its network
    drive hangs.
    """
    now, failing = 1000.0, False
    monkeypatch.setattr(api_keys.time, "monotonic", lambda: now)
    monkeypatch.setattr(api_keys, "_CHECK_S", 0.0)
    text = json.dumps({"keys": [{"name": "arm", "sha256": hashlib.sha256(b"k").hexdigest()}]})

    def read() -> str:
        if failing and at == "read":
            raise error
        return text

    def changed() -> object:
        if failing and at == "changed":
            raise error
        return failing

    keys = Keys(read, changed)
    failing = True
    for _ in range(3):
        keys.check("k", "noop").take_request()
        now += 100
    assert keys.unreadable_s == 300
    now += 1
    with pytest.raises(Unauthorized):
        keys.check("k", "noop")
    failing = False
    keys.check("k", "noop").take_request()


def test_a_change_of_mode_alone_is_looked_at(file: Path) -> None:
    new_key(file, "arm")
    before = api_keys._stamp(file)
    file.chmod(0o640)
    assert api_keys._stamp(file) != before


def test_the_file_keeps_its_owner_and_its_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    """The user who revokes a key may differ from the user who runs the server."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        file = folder / "keys.json"
        new_key(file, "arm")
        if os.geteuid() == 0:
            os.chown(file, 1234, 1235)
        file.chmod(0o640)
        before = file.stat()
        synced: list[int] = []
        sync = os.fsync
        monkeypatch.setattr(
            key_store.os, "fsync", lambda descriptor: (synced.append(descriptor), sync(descriptor))
        )
        revoke(file, "arm")
        after = file.stat()
        assert (after.st_uid, after.st_gid, after.st_mode) == (
            before.st_uid,
            before.st_gid,
            before.st_mode,
        )
        assert read_keys(file)[0].revoked
        assert len(synced) == 2  # the file and its folder


def test_a_file_that_cannot_be_given_to_its_owner_is_left_as_it_is(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    new_key(file, "arm")
    before = file.read_text()
    asked: list[tuple[int, int]] = []

    def refuse(_: int, user: int, group: int) -> None:
        asked.append((user, group))
        raise PermissionError(1, "Operation not permitted")

    real = os.fstat

    def stat_of_another_user(file: int) -> os.stat_result:
        return os.stat_result((*real(file)[:4], 4321, 4321, *real(file)[6:]))

    monkeypatch.setattr(key_store.os, "fstat", stat_of_another_user)
    monkeypatch.setattr(key_store.os, "fchown", refuse)
    with pytest.raises(ConfigError, match="nothing was changed"):
        revoke(file, "arm")
    assert asked == [(os.getuid(), os.getgid())]
    assert file.read_text() == before
    assert list(file.parent.iterdir()) == [file]


def test_a_rate_is_kept_by_name_over_all_connections(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1000.0
    monkeypatch.setattr(api_keys.time, "monotonic", lambda: now)
    token = new_key(file, "arm", rate=4)
    keys = Keys.from_file(file)
    callers = [keys.check(token, "noop") for _ in range(4)]
    for caller in callers:
        caller.take_request()
    with pytest.raises(TooManyRequests, match="send fewer, or ask the operator") as refused:
        callers[0].take_request()
    assert refused.value.retry_after_s == pytest.approx(0.25)
    callers[0].require()
    now += 0.25
    callers[1].take_request()
    with pytest.raises(TooManyRequests):
        callers[2].take_request()


@pytest.mark.parametrize("compact", [True, False])
def test_each_request_of_a_message_is_charged_to_the_key_once(
    file: Path, monkeypatch: pytest.MonkeyPatch, compact: bool
) -> None:
    monkeypatch.setattr(api_keys.time, "monotonic", lambda: 1000.0)
    token = new_key(file, "arm", rate=3)
    caller = Keys.from_file(file).check(token, "noop")
    engine, requests = Engine(Noop.from_config({})), [Request("reset", Obs())] * 3
    sender, decoded, admission = (
        Sender(engine, "any", caller=caller, has_left=None),
        Decoded(requests, {}),
        None,
    )
    charge = Account(caller).charge()
    if not compact:
        admission = message_admission(engine, charge, DEFAULT_LIMITS)
        decoded = decode_requests(encode_requests(requests), admission)
    message = sender.message(charge)
    sender.send(message, decoded, Calls(ignore), admission=admission)
    engine.close()
    # The engine has not been started.
    assert [type(reply.error) for reply in message.replies] == [NoReplica] * 3
    with pytest.raises(TooManyRequests):
        caller.take_request()


def test_an_engine_accepts_no_message_that_is_not_charged_to_its_sender(file: Path) -> None:
    token = new_key(file, "arm")
    caller = Keys.from_file(file).check(token, "noop")
    engine = Engine(Noop.from_config({}))
    sender = Sender(engine, "any", caller=caller, has_left=None)
    uncharged, free_of_charge = IncomingMessage("any"), sender.message(free(NoKey.OPEN))
    for message in (uncharged, free_of_charge):
        with pytest.raises(
            TypeError,
            match="has charged to its sender's key",
        ):
            sender.send(message, Decoded([Request("reset", Obs())], {}), Calls(ignore))
    engine.close()
    with pytest.raises(TypeError, match="identify the client before its first message"):
        Account().charge()


def test_the_file_holds_hashes_for_its_owner_alone(file: Path) -> None:
    token = new_key(file, "arm", priority="simulation", sessions=3)
    assert token not in file.read_text()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    (key,) = read_keys(file)
    assert key.sha256 == hashlib.sha256(token.encode()).hexdigest()
    assert (key.priority, key.sessions) == ("simulation", 3)
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
        ({"priority": "king"}, "robot"),
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
        load_keys(None, {FILE_VARIABLE: str(file)}),
        load_keys(None, {api_keys.TEXT_VARIABLE: file.read_text()}),
    ):
        keys.check(token, "noop")
    assert load_keys(None, {}) is None
    with pytest.raises(ConfigError, match="keys create"):
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
    for host in ("0.0.0.0", "192.0.2.1", "::", "", "127.example.org"):  # noqa: S104 - an address that is rejected
        with pytest.raises(ConfigError, match="--insecure"):
            require_access(host, None, insecure=False)
        require_access(host, Keys.from_file(file), insecure=False)
        require_access(host, None, insecure=True)


def test_keys_over_plain_http_are_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    api_keys.warn_of_plain_http("127.0.0.1")
    assert not caplog.records
    api_keys.warn_of_plain_http("0.0.0.0")  # noqa: S104 - an address that causes a warning
    assert "--plain-http" in caplog.text


def test_the_audit_log_says_which_key_did_what_and_not_each_time(
    file: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", audit.LOG)
    now = 1000.0
    monkeypatch.setattr(audit.time, "monotonic", lambda: now)
    token = new_key(file, "arm", rate=1e-6)
    keys = Keys.from_file(file)
    caller = keys.check(token, "noop")
    for _ in range(50):
        caller.note("let in by", "http")
        caller.note("reset session", repr("robot-1"))
        with contextlib.suppress(TooManyRequests):
            caller.take_request()
        with pytest.raises(Unauthorized):
            keys.check("wrong", "noop")
    lines = [record.getMessage() for record in caplog.records if record.name == audit.LOG]
    assert lines == [
        "key arm: let in by http",
        "key arm: reset session 'robot-1'",
        "key (none): rejected: an unknown key",
        "key arm: rejected: too_many_requests",
    ]
    now += audit._EVERY_S
    caller.note("reset session", repr("robot-2"))
    assert (
        caplog.records[-1].getMessage()
        == "key arm: reset session 'robot-2' (49 more like this since the last line)"
    )
    assert token not in caplog.text


def test_a_reset_stands_in_the_audit_log_with_its_key_and_its_session(
    file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", audit.LOG)
    token = new_key(file, "arm")
    caller = Keys.from_file(file).check(token, "noop")
    engine = Engine(Noop.from_config({}))
    engine.start()
    answered: queue.SimpleQueue[list[Reply]] = queue.SimpleQueue()
    send(
        Sender(engine, "http", "robot-1", connected=False, caller=caller, has_left=None),
        [Request("reset", Obs())],
        answered.put,
    )
    [reply] = answered.get(timeout=30)
    engine.close()
    assert reply.error is None
    assert "key arm: reset session 'robot-1'" in [record.getMessage() for record in caplog.records]


def test_a_replica_writes_the_audit_log_where_nobody_has_set_up_logging(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # As in a process whose root logger has no handlers.
    monkeypatch.setattr(audit.logger, "propagate", False)
    monkeypatch.setattr(audit.logger, "handlers", [])
    monkeypatch.setattr(audit.logger, "level", logging.NOTSET)
    audit.write_audit()
    audit.write_audit()
    Keys.from_file(_one_key(file)).audit.did("arm", "let in by", "http")
    assert capsys.readouterr().err.count("vlagents_ray.serve.audit: key arm: let in by http") == 1


def test_the_audit_log_goes_on_where_stderr_was_replaced_and_closed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(audit.logger, "propagate", False)
    monkeypatch.setattr(audit.logger, "handlers", [])
    monkeypatch.setattr(audit.logger, "level", logging.NOTSET)
    with io.StringIO() as replaced, contextlib.redirect_stderr(replaced):
        audit.write_audit()
    audit.log_pressed("lab", "'pause'")
    assert capsys.readouterr().err.endswith("key lab: pressed 'pause'\n")


def _one_key(file: Path) -> Path:
    new_key(file, "arm")
    return file
