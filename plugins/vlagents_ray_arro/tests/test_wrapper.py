"""ARRO around policies: the images that they get, what is reported, and errors."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomllib
import yaml
from in_process_replicas import Replicas

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.cli.listing import policies_and_wrappers
from vlagents_ray.contract import CameraSpec, Contract
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.errors import (
    ConfigError,
    InvalidObservation,
    MissingCamera,
    NotReset,
    UnknownWrapper,
)
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.policies.base.checkpoint import find_checkpoint
from vlagents_ray.policies.base.checkpoint_files import digest
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.registry import wrapper_class
from vlagents_ray.testing import check_agent
from vlagents_ray_arro import Arro, ArroConfig
from vlagents_ray_arro.parts import Detection
from vlagents_ray_arro.wrapper import with_parts

ROOT = Path(__file__).parents[3]
BACKGROUND = (0, 0, 60)
PARTS: dict[str, Any] = {
    "detector": "colour",
    "segmenter": "flat",
    "selector": None,
    "tracker": "iou",
    "background": {"colour": BACKGROUND},
}
GREY, RED, BLUE = (200, 200, 200), (220, 40, 40), (40, 60, 220)


class Watcher(Agent):
    """Stores the images of its observations."""

    contract = Contract(cameras={"front": CameraSpec()})

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.seen = [obs.cameras["front"]]
        return {"told": instruction}

    def act(self, obs: Obs) -> Act:
        self.seen.append(obs.cameras["front"])
        return Act(np.zeros(1, np.float32), info={"own": 1})


class OwnDetector:
    """A detector from elsewhere, which returns boxes without masks."""

    Config = dict

    def __init__(self, config: Mapping[str, Any]) -> None:
        self._boxes = config["boxes"]

    def load(self) -> None:
        pass

    def detect(self, images: Any, phrases: Any) -> list[list[Detection]]:
        boxes = [np.array(box, np.float32) for box in self._boxes]
        detections = []
        for image_phrases in phrases:
            detections.append([Detection(image_phrases[0], box, 1.0) for box in boxes])
        return detections


def arro(agent: Agent | None = None, **settings: Any) -> Any:
    wrapped = Arro.around(agent or Watcher(), {**PARTS, **settings})
    wrapped.initialize()
    return wrapped


def view(*squares: tuple[tuple[int, int, int], int, int], **cameras: np.ndarray) -> Obs:
    """Return squares of 10 px on grey, each with its colour, row and column."""
    image = np.full((60, 80, 3), GREY, np.uint8)
    for colour, row, column in squares:
        image[row : row + 10, column : column + 10] = colour
    return Obs(cameras={"front": image, **cameras})


def shown(image: np.ndarray) -> set[tuple[int, ...]]:
    """Return the colours of an image."""
    return {tuple(pixel) for pixel in image.reshape(-1, 3).tolist()}


def test_a_policy_sees_the_things_that_are_named_and_nothing_else() -> None:
    policy = arro()
    info = policy.reset(view((RED, 10, 10), (BLUE, 40, 60)), "lift the red cube")
    act = policy.act(view((RED, 12, 14), (BLUE, 40, 60)))

    report = {"front": {"seen": ["lift the red cube"], "missing": [], "searched": False}}
    assert info == {
        "told": "lift the red cube",
        "arro": {"front": {**report["front"], "searched": True}},
    }
    assert act.info == {"own": 1, "arro": report}

    first, second = policy.agent.seen
    for image, row, column in ((first, 10, 10), (second, 12, 14)):
        assert shown(image) == {BACKGROUND, RED}
        assert (image[row : row + 10, column : column + 10] == RED).all()


def test_objects_of_the_config_stand_in_for_those_of_the_instruction() -> None:
    policy = arro(objects=["blue thing"])
    policy.reset(view((RED, 10, 10), (BLUE, 40, 60)), None)
    assert shown(policy.agent.seen[0]) == {BACKGROUND, BLUE}


def test_segments_are_widened_by_grow() -> None:
    policy = arro(grow=2)
    policy.reset(view((RED, 10, 10)), "red")
    assert (policy.agent.seen[0][8:22, 8:22] != BACKGROUND).any(-1).all()
    assert shown(policy.agent.seen[0]) == {BACKGROUND, RED, GREY}


def test_other_cameras_pass_as_they_are() -> None:
    policy = arro()
    wrist = np.full((8, 8, 3), 7, np.uint8)
    obs = view((RED, 10, 10), wrist=wrist)
    assert policy.begin(obs, "red").cameras["wrist"] is wrist


def test_the_segmenter_computes_masks_for_a_detector_that_returns_boxes() -> None:
    policy = arro(detector={f"{__name__}:OwnDetector": {"boxes": [[5, 5, 25, 25]]}})
    policy.reset(view((RED, 10, 10), (BLUE, 40, 60)), "it")
    assert shown(policy.agent.seen[0]) == {BACKGROUND, RED}


def test_a_lost_thing_is_shown_where_it_was_for_a_while_then_hidden_and_looked_for() -> None:
    policy = arro(keep_lost=2)
    policy.reset(view((RED, 10, 10)), "red")
    policy.act(view((RED, 10, 10)))

    reports = [policy.act(view()).info["arro"]["front"] for _ in range(4)]
    assert [report["searched"] for report in reports] == [False, False, True, False]
    assert all(report["missing"] == ["red"] and not report["seen"] for report in reports)
    assert [shown(image) for image in policy.agent.seen[2:]] == 2 * [{BACKGROUND, GREY}] + 2 * [
        {BACKGROUND}
    ]

    for _ in range(2):  # it is back, far from its last position, and found at the next search
        report = policy.act(view((RED, 45, 65))).info["arro"]["front"]
    assert report == {"seen": ["red"], "missing": [], "searched": True}
    assert shown(policy.agent.seen[-1]) == {BACKGROUND, RED}


def test_an_episode_without_what_is_named_is_refused() -> None:
    policy = arro(objects=["red", "blue"])
    with pytest.raises(
        InvalidObservation,
        match=r"'front' shows none of \['blue'\], found \['red'\].*missing: hide",
    ):
        policy.reset(view((RED, 10, 10)), None)


def test_or_it_begins_without_and_looks_again() -> None:
    policy = arro(objects=["red", "blue"], missing="hide", keep_lost=0)
    policy.reset(view((RED, 10, 10)), None)
    assert policy.act(view((RED, 10, 10))).info["arro"]["front"]["missing"] == ["blue"]
    assert policy.act(view((RED, 10, 10), (BLUE, 40, 60))).info["arro"]["front"]["seen"] == [
        "red",
        "blue",
    ]


def test_without_an_instruction_or_objects_there_is_nothing_to_find() -> None:
    with pytest.raises(InvalidObservation, match="or set `objects`"):
        arro().reset(view(), "")


def test_a_bad_observation_fails_its_own_session_alone() -> None:
    policy = arro()
    copies = AgentCopies(policy)
    sessions: list[Any] = [copies.make() for _ in range(3)]
    for session in sessions:
        session.reset(view((RED, 10, 10)), "red")

    small = Obs(cameras={"front": np.zeros((30, 40, 3), np.uint8)})
    no_camera, good, resized = policy.act_batch([Obs(), view((RED, 10, 10)), small], sessions)
    assert isinstance(no_camera, MissingCamera)
    assert isinstance(good, Act)
    assert isinstance(resized, InvalidObservation)
    assert isinstance(sessions[0].act(view((RED, 10, 10))), Act)  # and its session continues


def test_the_contract_asks_for_what_it_is_to_change_and_an_instruction() -> None:
    class Stateless(Watcher):
        contract = Contract()

    contract = arro(Stateless(), cameras=["wrist"]).contract
    assert contract.cameras == {"wrist": CameraSpec()}
    assert contract.instruction
    assert not arro(objects=["red"]).contract.instruction


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cameras": ["wirst"]}, r"cameras \['wirst'\] are none of the policy's, \['front'\]"),
        ({"background": {"image": "no/such.png"}}, "no/such.png.*cannot be read"),
        ({"background": {"image": "a.png", "grid": [1, 2, 3]}}, "image excludes"),
        ({"background": {"colour": [0, 0, 256]}}, "from 0 to 255"),
        ({"objects": []}, "objects"),
        ({"colour": "red"}, "wrapper Arro.*colour"),
        ({"tracker": "kalman"}, "tracker: expected one of .*got 'kalman'"),
    ],
)
def test_settings_that_cannot_work_are_refused_before_serving(
    settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=f"(?s){message}"):
        arro(**settings)


def test_the_package_registers_its_wrapper_by_an_entry_point(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pyproject = tomllib.loads((ROOT / "plugins/vlagents_ray_arro/pyproject.toml").read_text())
    entry_points = pyproject["project"]["entry-points"]
    [(name, target)] = entry_points["vlagents_ray.wrappers"].items()
    info = tmp_path / "vlagents_ray_arro-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: vlagents_ray_arro\nVersion: 1\n")
    (info / "entry_points.txt").write_text(f"[vlagents_ray.wrappers]\n{name} = {target}\n")
    monkeypatch.syspath_prepend(tmp_path)

    assert wrapper_class("arro") is Arro
    [listed] = [entry for entry in policies_and_wrappers() if entry.name == "arro"]
    assert (listed.kind, listed.what[:11]) == ("wrapper", "ARRO (arXiv")
    with pytest.raises(
        UnknownWrapper, match=r"'aro', which is not registered.*did you mean 'arro'"
    ):
        wrapper_class("aro")


def test_its_deployment_file_is_right() -> None:
    [app] = yaml.safe_load((ROOT / "plugins/vlagents_ray_arro/arro.yaml").read_text())[
        "applications"
    ]
    [entry] = app["args"]["wrappers"]
    assert ArroConfig(**entry["arro"]).detector == "colour"


def test_acting_before_a_reset_is_refused() -> None:
    with pytest.raises(NotReset):
        arro().act(view())


def test_a_session_that_travels_goes_on_as_if_it_had_stayed() -> None:
    here = AgentCopies(arro())
    there = AgentCopies(arro())
    staying: Any = here.make()
    staying.reset(view((RED, 10, 10), (RED, 10, 60)), "red")
    travelling: Any = there.load(here.dump(staying))
    for x in range(10, 30, 4):
        obs = view((RED, 10, x), (BLUE, 40, 60))
        assert staying.act(obs).info == travelling.act(obs).info
        assert np.array_equal(staying.agent.seen[-1], travelling.agent.seen[-1])


SETTINGS = {**PARTS, "selector": "circle"}


def test_keeps_the_promises_of_an_agent() -> None:
    begun = []
    for seed in range(3):
        env = Tabletop()
        begun.append((env.reset(seed=seed)[0], env.instruction))
    check_agent(
        build_agent("scripted", {}, [{"vlagents_ray_arro:Arro": SETTINGS}]),
        obs=[obs for obs, _ in begun],
        instructions=[instruction for _, instruction in begun],
        reset_kwargs={"env": "tabletop"},
    )


def test_an_expert_that_sees_only_segments_still_solves_its_tasks() -> None:
    replicas = Replicas([build_agent("scripted", {}, [{"vlagents_ray_arro:Arro": SETTINGS}])])

    def solves(seed: int) -> bool:
        env, agent = Tabletop(), replicas.agent()
        obs, info = env.reset(seed=seed)
        agent.initialize()
        agent.reset(obs, env.instruction, env="tabletop")
        truncated = False
        while not truncated and not info["success"]:
            obs, _, _, truncated, info = env.step(agent.act(obs))
        agent.close()
        return bool(info["success"])

    try:
        with ThreadPoolExecutor(4) as robots:
            assert all(robots.map(solves, range(4)))
    finally:
        replicas.close()


class Stored(OwnDetector):
    """A detector with a file."""

    def load(self) -> None:
        find_checkpoint("detector.pt")


class StoredPolicy(Watcher):
    """A policy with a file, or with an identity that it declares itself."""

    declared_id: dict[str, Any] | None = None

    def initialize(self) -> None:
        find_checkpoint("policy.pt")
        self.weights_id = self.declared_id


@pytest.mark.parametrize("declared_id", [None, {"digest": "mine", "revision": "c0ffee"}])
def test_the_weights_are_those_of_the_policy_and_of_the_parts(
    declared_id: dict[str, Any] | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(StoredPolicy, "declared_id", declared_id)
    ids = []
    for policy, detector in ((b"1", b"1"), (b"1", b"1"), (b"1", b"2"), (b"2", b"1")):
        Path("policy.pt").write_bytes(policy)
        Path("detector.pt").write_bytes(detector)
        detector_settings = {f"{__name__}:Stored": {"boxes": [[10, 10, 20, 20]]}}
        ids.append(arro(StoredPolicy(), detector=detector_settings).weights_id)

    assert ids[0] == ids[1] != ids[2]
    # A declared identity replaces that of the file.
    assert (ids[0] == ids[3]) == (declared_id is not None)
    assert {**ids[0], "digest": ""} == {"revision": None, **(declared_id or {}), "digest": ""}


def test_other_parts_beside_a_policy_are_other_weights(tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / name).write_text(name)
    policy = {"digest": digest([tmp_path]), "revision": "c0ffee"}
    assert with_parts(policy, []) == policy
    both = with_parts(policy, [tmp_path / "a"])
    assert both is not None
    assert both["digest"] not in (policy["digest"], digest([tmp_path / "a"]))
    assert both["revision"] == "c0ffee"
    assert with_parts(None, [tmp_path / "a"]) != with_parts(None, [tmp_path / "b"])
