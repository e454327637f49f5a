"""The commands, options, keys and files in the pages under docs/ are valid, also in the parts that
are generated for the site. `mkdocs build --strict` checks links and sections.
"""

from __future__ import annotations

import re
import runpy
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import yaml
from generated import filled
from ray.serve.schema import ServeApplicationSchema
from readme_blocks import PAGES, commands, options_of, read_as_typed, section
from reference import sections

from vlagents_ray import registry
from vlagents_ray.cli.evaluate import read_run
from vlagents_ray.envs.gymnasium import defaults_for
from vlagents_ray.envs.simulator import BenchmarkProtocol
from vlagents_ray.errors import BY_CODE, Overloaded
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.interface import Act
from vlagents_ray.protocol import frame_layout, frames, json_messages, messages, values
from vlagents_ray.protocol.messages import MessageLimits, Reply
from vlagents_ray.serve.config.deployment import EnvironmentArgs, ServerArgs
from vlagents_ray_sims import aloha, calvin, metaworld, robocasa
from vlagents_ray_sims.robosuite import TASKS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
README = (ROOT / "README.md").read_text()
_ON_ONE_MACHINE = {
    "shared memory": "shm",
    "plasma": "plasma, Ray actor",
    "*openpi*": "*openpi*",
    "WebSocket, default": "websocket, default",
    "*vlagents, shared memory*": "*vlagents shm*",
    "*OpenVLA REST*": "*OpenVLA REST*",
}
_ENVIRONMENTS = (DOCS / "python_environments.md").read_text()
BLOCKS = re.findall(r"```yaml\n(applications:.*?)```", _ENVIRONMENTS, re.DOTALL)


@pytest.mark.parametrize("block", BLOCKS)
def test_an_environment_as_it_is_documented_is_accepted(block: str) -> None:
    [application] = yaml.safe_load(block)["applications"]
    ServeApplicationSchema.model_validate(application)
    assert (
        application.get("runtime_env")
        or ServerArgs(**application["args"]).environment != EnvironmentArgs()
    )


@pytest.fixture(scope="module")
def texts() -> dict[str, str]:
    """Return the text of each page as on the site, by its path in the checkout."""
    return {str(page.relative_to(ROOT)): filled(page.read_text()) for page in PAGES}


def test_the_tests_that_pages_name_exist(texts: dict[str, str]) -> None:
    folders = [ROOT, ROOT / "plugins"]
    missing = []
    for page, text in texts.items():
        named = set(re.findall(r"`((?:tests|\w+/tests)/[\w/]+\.py)`", text))
        for name in named:
            if not any((top / name).is_file() for top in folders):
                missing.append(f"{page}: {name}")
        if page == "docs/guarantees.md":
            assert named
    assert missing == []


def test_the_tables_of_tests_that_contributing_names_exist() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text()
    tables = re.findall(r"`([A-Z_]{4,})`(?=[^|;]*? of `(tests/[\w/]+\.py)`)", text)
    missing = []
    for table, file in tables:
        if not re.search(rf"^{table}\b.* = ", (ROOT / file).read_text(), re.MULTILINE):
            missing.append(f"{table} of {file}")
    assert missing == []
    assert len(tables) >= 6


def test_the_commands_on_pages_are_such_as_the_command_line_takes(texts: dict[str, str]) -> None:
    wrong = []
    for page, text in texts.items():
        for line, whole in commands(text):
            try:
                read_as_typed(line, whole=whole)
            except ValueError as error:
                wrong.append(f"{page}: {error}")
    assert wrong == []


# Commands whose options a page explains without a line that begins with `vlagents-ray`.
EXPLAINED = {
    "checkpoints.md": ["eval"],
    "failures.md": ["eval"],
    "gpu.md": ["eval"],
    "kubernetes.md": ["eval"],
    "learn.md": ["eval"],
    "libero.md": ["eval"],
    "live.md": ["serve"],
    "measured.md": ["serve"],
    "policies.md": ["serve"],
    "programs.md": ["robot"],
    "slurm.md": ["serve"],
    "troubleshooting.md": ["eval", "serve"],
}
# Options of sbatch, docker, ray and uv, of LeRobot's and GR00T's programs, and of the checkout's
# scripts.
OF_OTHERS = {
    "--account",
    "--array",
    "--build-context",
    "--dtype",
    "--fps",
    "--health-cmd",
    "--ipc",
    "--max-lag",
    "--mem",
    "--name",
    "--nodes",
    "--ntasks",
    "--qos",
    "--requeue",
    "--shm-size",
    "--size",
    "--steps",
    "--target",
    "--temp-dir",
    "--time",
    "--use-sim-policy-wrapper",
}


def test_an_option_in_a_sentence_is_one_of_a_command_that_its_page_names(
    texts: dict[str, str],
) -> None:
    """For example, `--only` in the text about `open-loop`, whose option is `--episodes`, would lead
    readers to an error.
    """
    unknown = []
    for page, text in texts.items():
        explained = [f"vlagents-ray {command}" for command in EXPLAINED.get(Path(page).name, [])]
        unknown += [f"{page}: {option}" for option in unknown_options(text, explained)]
    assert unknown == []


def test_an_option_that_no_command_of_its_page_has_is_found() -> None:
    text = "`vlagents-ray open-loop DATASET` sends it. `--cameras a=b` maps names, `--episodes 3` selects"
    assert unknown_options(text) == ["--cameras"]


def unknown_options(text: str, explained: Sequence[str] = ()) -> list[str]:
    """Return the options in sentences that no command on the page has, and that are not in
    `explained`.
    """
    named = [*explained, *(line for line, _ in commands(text))]
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    mentioned = [" ".join(code.split()) for code in re.findall(r"`([^`]*)`", prose)]
    options = [
        code.partition(" ")[0].partition("=")[0]
        for code in mentioned
        if re.match(r"--\w[^. ]*( |=|$)", code)
    ]
    have = set().union(*(options_of(line) for line in named)) | OF_OTHERS
    return [option for option in options if option not in have]


def keys_by_section() -> dict[str, set[str]]:
    """Return the keys below each key of a deployment file and of a run file."""
    keys: dict[str, set[str]] = {}
    for model, path in [*sections(ServerArgs, ""), *sections(EvalConfig, "")]:
        section_name = path.rpartition(".")[2]
        if section_name and section_name != "robot":  # in sentences `robot.NAME` is Python
            keys.setdefault(section_name, set()).update(model.model_fields)
    return keys


KEYS = keys_by_section()
NO_KEYS = {"checkpoints.swap"}  # keys in the statistics of a server


def test_a_key_of_a_file_in_a_sentence_exists(texts: dict[str, str]) -> None:
    unknown = [f"{page}: {key}" for page, text in texts.items() for key in unknown_keys(text)]
    assert unknown == []


def test_a_key_that_no_file_has_is_found() -> None:
    assert unknown_keys("Set `batch.max_sizes`, `batch.max_size=8` or `worker.cpus`.") == [
        "batch.max_sizes"
    ]


def unknown_keys(text: str) -> list[str]:
    """Return the keys in sentences, such as `batch.max_size`, that no section has."""
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    named = re.findall(r"`(\w+)\.(\w+)(?:[=:][^`]*)?`", prose)
    return [
        f"{section_name}.{key}"
        for section_name, key in named
        if section_name in KEYS
        and key not in KEYS[section_name]
        and f"{section_name}.{key}" not in NO_KEYS
    ]


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("vlagents-ray serve noop --prot 8000", "--prot"),
        ("vlagents-ray serve noop --port eight", "eight"),
        ("vlagents-ray serv noop", "serv"),
        ("vlagents-ray venv create", "requirements"),
        ("vlagents-ray eval", "FILE"),
    ],
)
def test_a_command_that_is_typed_wrong_is_found(line: str, says: str) -> None:
    with pytest.raises(ValueError, match=f"(?i){says}"):
        read_as_typed(line, whole=True)


def test_there_are_commands_and_blocks_on_the_pages(texts: dict[str, str]) -> None:
    found = [command for text in texts.values() for command in commands(text)]
    assert len([line for line, whole in found if whole]) > 40
    assert (len(found) > 70, len(BLOCKS)) == (True, 2)


def test_the_file_of_runs_behind_the_reports_picture_is_accepted() -> None:
    config = EvalConfig.model_validate(read_run(DOCS / "evaluation" / "picture.yaml"))
    assert [policy.source for policy in config.policies] == [
        "learner:Learner",
        "scripted",
        "random",
    ]


def test_files_of_runs_on_the_pages_are_accepted() -> None:
    others = [DOCS / "cluster" / "scaling.md", DOCS / "evaluation" / "robot.md"]
    pages = [*sorted((DOCS / "benchmarks").glob("*.md")), *others]
    blocks = [
        block
        for page in pages
        for block in re.findall(r"```yaml\n(policies:.*?)```", page.read_text(), re.DOTALL)
    ]
    assert blocks
    for block in blocks:
        assert EvalConfig.model_validate({"out": "runs/documented"} | yaml.safe_load(block)).suites


@pytest.mark.parametrize(
    ("page", "protocol"),
    [
        ("gymnasium#meta-world", metaworld.PROTOCOL),
        ("gymnasium#aloha", aloha.PROTOCOL),
        ("gymnasium#pusht", defaults_for("gym_pusht/PushT-v0").protocol),
        ("gymnasium#fetch-gymnasium-robotics", defaults_for("FetchReach-v4").protocol),
        ("robosuite#robosuite", TASKS["Lift"].protocol),
        ("other#calvin", calvin.PROTOCOL),
        ("robosuite#robocasa", robocasa.protocol("OpenDrawer", "target")),
    ],
)
def test_a_benchmarks_page_states_the_protocol_that_is_recorded(
    page: str, protocol: BenchmarkProtocol
) -> None:
    rows = dict(re.findall(r"^\| (\w+) \| (.*) \|$", section("benchmarks", page), re.MULTILINE))
    assert re.match(r"\d+", rows["steps"]).group() == str(protocol.max_steps)  # type: ignore[union-attr]
    assert rows["rate"] == f"{protocol.control_hz:g} Hz"
    assert ("ends the episode" in rows["success"]) is protocol.ends_on_success


def test_troubleshooting_has_every_error_with_its_status_and_a_cure_and_no_other() -> None:
    page = _read("troubleshooting.md")
    rows = re.findall(r"^\| `(\w+)` \| (\d+) \| `(\w+)` \| .+ \| .+ \|$", page, re.MULTILINE)
    assert sorted(rows) == sorted(
        (code, str(error.status), error.__name__) for code, error in BY_CODE.items()
    )
    assert len(rows) == len(re.findall(r"^\| `(\w+)` \| \d+ \|", page, re.MULTILINE))


PROTOCOL = (DOCS / "protocol.md").read_text()


def test_the_protocol_has_every_key_header_limit_and_type() -> None:
    keys = {*frames._REQUEST_KEYS, *json_messages._KEYS, *values._OBS_KEYS}
    reply = Reply(
        "r", Act(np.zeros(1, np.float32)), step=1, draining=True, timing={"queue_ms": 1.0}
    )
    failed = Reply("r", error=Overloaded("full"))
    for one in (reply, failed):
        header, _ = frame_layout.unpack(frames.encode_replies([one, one]), MessageLimits())
        keys |= header.keys() | header["replies"][0].keys()
        keys |= (
            header["replies"][0].get("act", {}).keys()
            | header["replies"][0].get("error", {}).keys()
        )
    keys |= {name for name in dir(messages) if name.endswith("_HEADER")}
    names = {getattr(messages, key, key) for key in keys} - {messages.MACHINE_HEADER}
    types = {np.dtype(code).newbyteorder("<").str.replace("|", "\\|") for code in "?bhiqBHIQefd"}
    names |= types | {field.name for field in fields(MessageLimits)} - {"in_flight_bytes"}
    assert {
        name for name in names if f"`{name}`" not in PROTOCOL and f'"{name}"' not in PROTOCOL
    } == set()


@pytest.mark.parametrize("name", ["pixels", "state_values", "text", "requests", "history"])
def test_the_protocol_states_the_limits_that_hold(name: str) -> None:
    rows = [line for line in PROTOCOL.splitlines() if line.startswith(f"| `{name}` |")]
    assert any(f" {getattr(MessageLimits(), name):,} " in row for row in rows)


def test_each_dialect_is_shown_among_the_clients_of_other_systems() -> None:
    pages = [DOCS / "other_clients.md", *sorted((DOCS / "clients").glob("*.md"))]
    text = "\n".join(page.read_text() for page in pages)
    lacking = []
    for name in registry.names("dialects"):
        if not re.search(rf"\b{name}:( {{|$)", text, re.MULTILINE):
            lacking.append(name)
    assert lacking == []


def test_the_figures_of_the_readme_are_the_measured_ones() -> None:
    measured = dict(
        re.findall(r"^\| (\S[^|]*?) \| (\d+\.\d+) \(", _read("measured.md"), re.MULTILINE)
    )
    for shown, name in _ON_ONE_MACHINE.items():
        [figure] = re.findall(rf"^\| {re.escape(shown)} \| (\S+) \|$", README, re.MULTILINE)
        assert f"{float(measured[name]):.{len(figure.partition('.')[2])}f}" == figure, shown


# Rows of docs/alternatives.md, and the rows of docs/measured.md that they quote.
_ALTERNATIVES = {
    "this server, shared memory": "shm",
    "this server, WebSocket": "websocket, default",
    "openpi": "*openpi*",
    "vlagents, shared memory": "*vlagents shm*",
    "TorchRL": "*TorchRL*",
    "vlagents, JPEG": "*vlagents JPEG*",
    "LeRobot": "*LeRobot*",
    "OpenVLA REST": "*OpenVLA REST*",
    "Ray Serve, handle": "*Ray Serve handle*",
    "Ray Serve, HTTP": "*Ray Serve HTTP*",
    "vla-eval": "*vla-eval*",
}


def test_the_figures_of_the_alternatives_are_the_measured_ones() -> None:
    lines = _read("measured.md").splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:]] for line in lines]
    measured = {row[0]: row for row in rows if len(row) > 4}
    quoted = re.findall(
        r"^\| ([^|]+) \| ([\d.]+) \| ([^|]+) \|$", _read("alternatives.md"), re.MULTILINE
    )
    assert [name for name, _, _ in quoted] == list(_ALTERNATIVES)
    for name, round_trip_ms, actions_a_second in quoted:
        row = measured[_ALTERNATIVES[name]]
        median_ms = float(row[1].partition(" ")[0])
        digits = len(round_trip_ms.partition(".")[2])
        assert f"{median_ms:.{digits}f}" == round_trip_ms, name
        assert row[3].partition(" ")[0] in (actions_a_second, ""), name


def test_the_pictures_are_those_that_their_script_draws() -> None:
    drawn = runpy.run_path(str(DOCS / "pictures" / "flows.py"))
    for name, picture in drawn["PICTURES"].items():
        file = DOCS / "pictures" / f"{name}.svg"
        assert file.read_text() == picture(), f"run {drawn['__file__']}"


def _anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings in the form of the site and of code hosts."""
    prose = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.+)$", prose, re.MULTILINE)
    plain = [re.sub(r"\[(.+?)\]\(.*?\)", r"\1", heading) for heading in headings]
    return {re.sub(r"[^\w\s-]", "", heading).strip().lower().replace(" ", "-") for heading in plain}


def test_readmes_that_are_not_on_the_site_link_to_files_and_sections_that_exist() -> None:
    pages = [ROOT / "README.md", *ROOT.glob("plugins/*/README.md"), *ROOT.glob("clients/*/*.md")]
    broken = []
    for page in pages:
        prose = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
        for path, anchor in re.findall(r"\]\((?!\w+:)([^)#\s]*)#?([^)\s]*)\)", prose):
            target = page.parent / path if path else page
            if not target.exists() or (anchor and anchor not in _anchors(target)):
                broken.append(f"{page.relative_to(ROOT)}: {path}#{anchor}")
    assert len(pages) > 12
    assert broken == []


def _read(page: str) -> str:
    return (DOCS / page).read_text()
