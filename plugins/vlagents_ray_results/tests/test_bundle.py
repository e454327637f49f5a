"""Tests of bundles: an honest bundle passes all checks, a changed bundle is contradicted, and a
hostile bundle is rejected.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sqlite3
import stat
import zipfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from eval_fakes import LINE
from in_process_evaluation import flat_config, play
from typer.testing import CliRunner

from vlagents_ray.cli.main import app
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import Results
from vlagents_ray.evaluate.artifacts.recorder import Trajectory
from vlagents_ray.evaluate.results.summary import summarize
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray_results.bundle import write_bundle
from vlagents_ray_results.merge import merge
from vlagents_ray_results.verification import Verification, verify

Change = Callable[[Path], None]


class Still(Agent):
    """Always returns the same action, which lifts the gripper's target a little."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, object]:
        return {"checkpoint": "still", "weights": "sha256:5711"}

    def act(self, obs: Obs) -> Act:
        return Act(np.array([0.1, 0.0, 0.2, 1.0], np.float32))


@pytest.fixture(scope="module")
def tabletop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of two recorded episodes of the tabletop."""
    out = tmp_path_factory.mktemp("tabletop") / "run"
    options = {"max_steps": 8}
    play(
        flat_config(
            envs=["tabletop"], env_options=options, episodes=2, record="all", video="all", out=out
        ),
        Still,
    )
    return out


@pytest.fixture(scope="module")
def line(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of three recorded episodes of an environment that is not registered."""
    out = tmp_path_factory.mktemp("line") / "run"
    play(flat_config(envs=[LINE], episodes=3, record="all", video="none", out=out))
    return out


@pytest.fixture
def changed(line: Path, tmp_path: Path) -> Callable[[Change], Path]:
    """Return a function that writes a bundle of a changed copy of `line`."""

    def make(change: Change) -> Path:
        shutil.copytree(line, tmp_path / "copy")
        change(tmp_path / "copy")
        write_bundle(tmp_path / "copy", tmp_path / "changed.zip")
        return tmp_path / "changed.zip"

    return make


def reasons(found: Verification) -> list[str | None]:
    return [episode.reason for episode in found.episodes]


def rewritten(
    bundle: Path, target: Path, changes: dict[str, bytes], *, honest: bool = False
) -> Path:
    """Write a bundle with other files; `honest` also writes their digests into the manifest, as the
    author could.
    """
    with zipfile.ZipFile(bundle) as source:
        files = {name: source.read(name) for name in source.namelist()} | changes
    if honest:
        manifest = json.loads(files["bundle.json"])
        manifest["files"] |= {
            name: {"sha256": hashlib.sha256(text).hexdigest(), "size": len(text)}
            for name, text in changes.items()
        }
        files["bundle.json"] = json.dumps(manifest).encode()
    with zipfile.ZipFile(target, "w") as out:
        for name, text in files.items():
            out.writestr(name, text)
    return target


@pytest.fixture(scope="module")
def bundle(tabletop: Path) -> Path:
    write_bundle(tabletop, tabletop.parent / "run.bundle.zip")
    return tabletop.parent / "run.bundle.zip"


def test_all_episodes_of_an_honest_bundle_are_reproduced(bundle: Path) -> None:
    found = verify(bundle)
    assert found.is_complete
    assert [(one.task, one.episode, one.reason) for one in found.episodes] == [
        ("tabletop", 0, None),
        ("tabletop", 1, None),
    ]


def test_the_same_results_give_the_same_bytes_and_the_digest_stands_for_them(
    bundle: Path, tmp_path: Path, tabletop: Path
) -> None:
    digest = write_bundle(tabletop, tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == bundle.read_bytes()
    assert verify(bundle, replay=0).digest == digest
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again.zip"]


def test_videos_are_in_it_if_that_is_asked_for(
    bundle: Path, tabletop: Path, tmp_path: Path
) -> None:
    write_bundle(tabletop, tmp_path / "with.zip", videos=True)
    verify(tmp_path / "with.zip", into=tmp_path / "kept", replay=0)
    videos = sorted((tmp_path / "kept").rglob("*.mp4"))
    assert len(videos) == 4  # videos of the report, and of the policy's images
    with zipfile.ZipFile(bundle) as file:
        assert not [name for name in file.namelist() if name.endswith(".mp4")]


def test_results_of_several_bundles_are_pooled(bundle: Path, line: Path, tmp_path: Path) -> None:
    write_bundle(line, tmp_path / "line.zip")
    for name, file in (("a", bundle), ("b", tmp_path / "line.zip")):
        verify(file, into=tmp_path / name, replay=0)
    assert merge(tmp_path / "all", [tmp_path / "a", tmp_path / "b"]).total.episodes == 5
    with pytest.raises(ConfigError, match="expected a new folder, got one that exists"):
        verify(bundle, into=tmp_path / "a")


def test_an_episode_with_other_actions_than_were_executed_is_not_reproduced(
    tabletop: Path, tmp_path: Path
) -> None:
    shutil.copytree(tabletop, tmp_path / "copy")
    path = next((tmp_path / "copy").rglob("ep0000*.npz"))
    path.write_bytes(other_actions(path))
    write_bundle(tmp_path / "copy", tmp_path / "changed.zip")
    [first, second] = reasons(verify(tmp_path / "changed.zip"))
    assert "expected finite numbers, got NaN" in str(first)
    assert second is None


def other_actions(path: Path) -> bytes:
    """Return the trajectory in a file, with a last action that cannot be executed."""
    recorded = Trajectory.load(path)
    recorded.actions[-1] = np.nan
    return recorded.to_bytes()


def recording(bundle: Path) -> str:
    """Return the name of the first trajectory in a bundle."""
    with zipfile.ZipFile(bundle) as file:
        return next(name for name in file.namelist() if name.endswith(".npz"))


def test_a_bundle_with_other_files_than_it_lists_is_refused(
    bundle: Path, tabletop: Path, tmp_path: Path
) -> None:
    name = recording(bundle)
    with pytest.raises(ConfigError, match=rf"got others \({name}\); copy the bundle again"):
        verify(rewritten(bundle, tmp_path / "b.zip", {name: other_actions(tabletop / name)}))


def test_summary_and_report_are_written_from_the_database(
    bundle: Path, tabletop: Path, tmp_path: Path
) -> None:
    verify(bundle, into=tmp_path / "run", replay=0)
    said = json.loads((tmp_path / "run/summary.json").read_text())
    assert said["totals"] == [group.to_json() for group in summarize(Results.load(tabletop)).totals]
    assert "report.html" in {path.name for path in (tmp_path / "run").iterdir()}


def test_an_environment_that_is_not_registered_is_made_for_those_who_trust_the_bundle(
    line: Path, tmp_path: Path
) -> None:
    write_bundle(line, tmp_path / "line.zip")
    for reason in reasons(verify(tmp_path / "line.zip")):
        assert str(reason).startswith("could not be executed: ")
        assert "is not a registered environment; --trust creates it, and runs its code" in reason
    assert verify(tmp_path / "line.zip", trust=True).is_complete


@pytest.mark.parametrize(
    "options",
    [
        {"assets": "../../etc"},
        {"nested": {"a": 1}},
        {"code": "os:system"},
        {"trust_remote_code": True},
        {"module": "evil"},
        {"source_dir": "here"},
    ],
)
def test_options_that_could_name_files_or_code_are_not_taken_from_a_stranger(
    bundle: Path, tmp_path: Path, options: dict[str, object]
) -> None:
    verify(bundle, into=tmp_path / "run", replay=0)
    with closing(sqlite3.connect(tmp_path / "run/results.db")) as db, db:
        [settings] = db.execute("SELECT settings FROM cases").fetchone()
        db.execute(
            "UPDATE cases SET settings = ?",
            (json.dumps(json.loads(settings) | {"env_options": options}),),
        )
    write_bundle(tmp_path / "run", tmp_path / "b.zip")
    for reason in reasons(verify(tmp_path / "b.zip")):
        assert "that cannot name files or code, got" in str(reason)


@pytest.mark.parametrize(
    "name",
    [
        "../results.db",
        "/tmp/results.db",
        "videos/../../x.mp4",
        "videos/a/.hidden.mp4",
        "sitecustomize.py",
        "videos\\a\\b.mp4",
        "report.html",
    ],
)
def test_a_path_that_no_bundle_has_is_refused_and_nothing_is_written(
    bundle: Path, tmp_path: Path, name: str
) -> None:
    hostile = rewritten(bundle, tmp_path / "b.zip", {name: b"x"}, honest=True)
    with pytest.raises(
        ConfigError,
        match=r"expected only files of results, got .*do not trust the author of this bundle",
    ):
        verify(hostile, into=tmp_path / "deep" / "kept")
    assert not list((tmp_path / "deep").iterdir())


def test_links_duplicates_and_archives_that_unpack_to_too_much_are_refused(
    bundle: Path, tmp_path: Path
) -> None:
    link = zipfile.ZipInfo("videos/a/b.mp4")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    for name, member, text, why in (
        ("link", link, "/etc/passwd", "is a link or another special file"),
        ("twice", zipfile.ZipInfo("bundle.json"), "{}", "got 'bundle.json' twice"),
    ):
        hostile = shutil.copy(bundle, tmp_path / f"{name}.zip")
        with zipfile.ZipFile(hostile, "a") as file, pytest.MonkeyPatch.context() as patch:
            # `zipfile` warns of duplicates.
            patch.setattr(file, "_writecheck", lambda _member: None)
            file.writestr(member, text)
        with pytest.raises(ConfigError, match=why):
            verify(hostile)
    with pytest.raises(
        ConfigError,
        match=r"expected at most 1000 unpacked bytes, got \d+; allow more with --max-gb",
    ):
        verify(bundle, most_bytes=1000)


@pytest.mark.parametrize(
    ("text", "why"),
    [(b"", "cannot be read as a bundle"), (b"PK\5\6" + 18 * b"\0", "got one without bundle.json")],
)
def test_what_is_no_bundle_is_said_to_be_none(tmp_path: Path, text: bytes, why: str) -> None:
    (tmp_path / "b.zip").write_bytes(text)
    with pytest.raises(ConfigError, match=why):
        verify(tmp_path / "b.zip")


def test_half_a_bundle_is_refused(bundle: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(bundle) as file:
        database = file.getinfo("results.db")
    text = bytearray(bundle.read_bytes())
    text[database.header_offset + 60 : database.header_offset + 90] = bytes(30)
    (tmp_path / "b.zip").write_bytes(text)
    with pytest.raises(
        ConfigError, match=r"cannot be read as a bundle \(.*copy it again from its source"
    ):
        verify(tmp_path / "b.zip")


def test_a_database_of_views_or_of_odd_values_is_refused(
    changed: Callable[[Change], Path], bundle: Path, tmp_path: Path
) -> None:
    verify(bundle, into=tmp_path / "run", replay=0)
    for sql, why in (
        ("CREATE VIEW x AS SELECT 1", "got 'x', a view that no evaluation makes"),
        ("UPDATE cases SET seeds = '[]'", "its database holds values that no evaluation writes"),
        (
            "UPDATE runs SET config = '{\"policies\": 1}'",
            "its database holds values that no evaluation writes",
        ),
        (
            "UPDATE episodes SET trajectory = '../x.npz'",
            "expected a file in the folder of results",
        ),
    ):
        shutil.copy(tmp_path / "run/results.db", tmp_path / "other.db")
        with closing(sqlite3.connect(tmp_path / "other.db")) as db, db:
            db.execute(sql)
        forged = {"results.db": (tmp_path / "other.db").read_bytes()}
        with pytest.raises(ConfigError, match=why):
            verify(rewritten(bundle, tmp_path / "b.zip", forged, honest=True), replay=0)


def test_a_recording_that_declares_more_than_it_has_is_not_reproduced(
    bundle: Path, tmp_path: Path
) -> None:
    name, npz = recording(bundle), tmp_path / "x.npz"
    header = (
        b"\x93NUMPY\x01\x00v\x00"
        + b"{'descr': '<f4', 'fortran_order': False, 'shape': (9999999999999, 99999), }".ljust(117)
        + b"\n"
    )
    with zipfile.ZipFile(npz, "w") as file:
        file.writestr("actions.npy", header)
        file.writestr("cameras.npy", header)
    found = verify(rewritten(bundle, tmp_path / "b.zip", {name: npz.read_bytes()}, honest=True))
    [first, second] = reasons(found)
    assert "cannot be read as a trajectory" in str(first)
    assert second is None


def test_a_module_that_an_id_of_gymnasium_names_is_not_imported(
    bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "of_this_machine.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    verify(bundle, into=tmp_path / "run", replay=0)
    with closing(sqlite3.connect(tmp_path / "run/results.db")) as db, db:
        db.execute("UPDATE cases SET env = 'gymnasium/of_this_machine/Task-v0'")
    write_bundle(tmp_path / "run", tmp_path / "b.zip")
    for reason in reasons(verify(tmp_path / "b.zip")):
        assert "is not a registered environment" in str(reason)


def test_an_evaluation_that_is_written_to_is_bundled_as_it_stands(
    line: Path, tmp_path: Path
) -> None:
    shutil.copytree(line, tmp_path / "run")
    with closing(sqlite3.connect(tmp_path / "run/results.db")) as db:
        db.execute("UPDATE episodes SET seconds = 99")
        write_bundle(tmp_path / "run", tmp_path / "b.zip")
        db.rollback()
        verify(tmp_path / "b.zip", into=tmp_path / "kept", replay=0)
    assert all(one.result.seconds < 99 for one in Results.load(tmp_path / "kept").cases[0].episodes)


def test_the_commands_print_the_rate_of_the_reproduced_episodes_and_end_with_1_if_some_are_not(
    tabletop: Path, tmp_path: Path
) -> None:
    def run(*words: object) -> tuple[int, str]:
        done = CliRunner().invoke(app, [*map(str, words)], env={"COLUMNS": "300"})
        return done.exit_code, " ".join(done.output.split())

    file = tmp_path / "b.zip"
    code, said = run("bundle", tabletop, "--out", file)
    digest = said.rpartition("sha256:")[2]
    assert (code, len(digest)) == (0, 64)
    code, said = run("verify", file, "--out", tmp_path / "kept")
    assert code == 0
    assert "policy tabletop 2 of 2 0% [0, 66] 2 of 2 episodes reproduced" in said
    assert f"bundle sha256:{digest} results: {tmp_path / 'kept'}" in said

    name = recording(file)
    forged = {name: other_actions(tabletop / name)}
    code, said = run("verify", rewritten(file, tmp_path / "c.zip", forged, honest=True))
    assert code == 1
    assert "policy tabletop 1 of 2 0% [0, 91] 0 to 50%" in said
    assert "tabletop#0@0 policy not solved, truncated after 8 steps there, " in said
    assert "1 of 2 episodes reproduced" in said

    code, said = run("verify", file, "--replay", 1, "--seed", 4)
    assert code == 0
    assert "1 of 1 episodes reproduced; drawn from 2 by --seed 4" in said
    code, said = run("verify", file, "--replay", 0)
    assert code == 0
    assert said.startswith("0 of 0 episodes reproduced; drawn from 2")
    code, said = run("verify", file, "--max-gb", "0.000001")
    assert code == 2
    assert "allow more with --max-gb if you trust it" in said

    code, said = run("verify", file, "--json")
    told = json.loads(said)
    assert (code, told["reproduced"], told["tried"], told["counted"]) == (0, 2, 2, 2)
    assert told["rates"][0]["success_once"]["episodes"] == 2
