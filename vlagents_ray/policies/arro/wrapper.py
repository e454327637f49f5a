"""The wrapper that shows the policy segments on a virtual background."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.contract import CameraSpec, Contract
from vlagents_ray.errors import ConfigError, InvalidObservation, MissingCamera, NotReset, VLAgentsError
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.arro.background import Background
from vlagents_ray.policies.arro.tracking import ArroConfig, Track, Tracking
from vlagents_ray.policies.base.checkpoint import used_checkpoints
from vlagents_ray.policies.base.checkpoint_files import weights_of, with_parts
from vlagents_ray.policies.wrapper import Wrapper

INFO = "arro"  # in Act.info and what `reset` returns: {camera: {"seen": labels, "missing": labels, "searched": bool}}


class Arro(Wrapper):
    """Paints over all but the gripper and the objects of the task, on the cameras of the config.

    Each session tracks its own objects; detector, segmenter and tracker get the images of all sessions of a batch
    together. `Obs.info` is not changed, so that an image in it, such as a goal, must already show its own background.
    """

    Config: ClassVar[type] = ArroConfig
    shared: ClassVar[tuple[str, ...]] = ("config", "tracking", "background")

    def __init__(self, agent: Agent, config: ArroConfig) -> None:
        """Wrap a policy.

        Args:
            agent: The policy.
            config: The cameras, the parts of their images to keep, and the models that find them.
        """
        super().__init__(agent, config)
        self.tracking = Tracking(config)
        self.background = Background(config.background)
        self.tracks: dict[str, Track] | None = None

    @property
    def contract(self) -> Contract:
        """The inner agent's contract, with the cameras of the config, and an instruction that names the objects."""
        inner = self.agent.contract or Contract()
        needed = {name: CameraSpec() for name in self.config.cameras or ()}
        return replace(
            inner,
            cameras={**needed, **(inner.cameras or {})} or inner.cameras,
            instruction=inner.instruction if self.config.objects else True,
        )

    def initialize(self) -> None:
        """Load the parts, then the inner agent."""
        with used_checkpoints() as parts:
            self.background.load()
            self.tracking.load()
        with used_checkpoints() as own:
            super().initialize()
        self.weights_id = with_parts(self.weights_id or weights_of(own), parts)
        stated = self.agent.contract.cameras if self.agent.contract is not None else None
        idle = sorted(set(self.config.cameras or ()) - set(stated or ())) if stated else []
        if idle:
            raise ConfigError(
                f"arro: cameras {idle} are none of the policy's, {sorted(stated or ())}; name some of those"
            )

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode of both; raises `InvalidObservation` if a required object is missing."""
        return {**super().reset(obs, instruction, **kwargs), INFO: self._report()}

    def begin(self, obs: Obs, instruction: str | None) -> Obs:
        names = self._names(obs)
        phrases = self.config.objects or ([instruction] if instruction else [])
        if not phrases:
            raise InvalidObservation("instruction: got none, want one that names the things to show; or set `objects`")
        tracks = self.tracking.begin([obs.cameras[name] for name in names], phrases)
        for name, track in zip(names, tracks, strict=True):
            if track.missing and self.config.missing == "refuse":
                raise InvalidObservation(
                    f"arro: camera {name!r} shows none of {track.missing}, found {track.seen}; is it in sight? Else "
                    f"name it in `objects` in other words, leave the camera out of `cameras`, or set missing: hide"
                )
        self.tracks = dict(zip(names, tracks, strict=True))
        return self._changed(obs)

    def change_batch(self, obs: Sequence[Obs], sessions: Sequence[Wrapper]) -> list[Obs | Exception]:
        results: list[Obs | Exception] = list(obs)
        images: list[np.ndarray] = []
        tracks: list[Track] = []
        for i, (one, session) in enumerate(zip(obs, sessions, strict=True)):
            try:
                views = session._views(one)  # type: ignore[attr-defined]
            except VLAgentsError as error:
                results[i] = error
                continue
            images += [image for image, _ in views]
            tracks += [track for _, track in views]
        self.tracking.follow(images, tracks)
        return [
            one if isinstance(one, Exception) else session._changed(one)  # type: ignore[attr-defined]
            for one, session in zip(results, sessions, strict=True)
        ]

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        acts = super().act_batch(obs, sessions)
        return [
            act if isinstance(act, Exception) else session._told(act)  # type: ignore[attr-defined]
            for act, session in zip(acts, sessions, strict=True)
        ]

    def _names(self, obs: Obs) -> list[str]:
        """Return the cameras that are changed."""
        stated = self.agent.contract.cameras if self.agent.contract is not None else None
        names = list(self.config.cameras or stated or obs.cameras)
        for name in names:
            if name not in obs.cameras:
                raise MissingCamera(name, have=obs.cameras)
        return names

    def _views(self, obs: Obs) -> list[tuple[np.ndarray, Track]]:
        """Return the images to change, with their tracks; raises before any of them is changed."""
        views = []
        for name, track in self._begun().items():
            if name not in obs.cameras:
                raise MissingCamera(name, have=obs.cameras)
            image = obs.cameras[name]
            if len(track.masks) and track.masks[0].shape != image.shape[:2]:
                raise InvalidObservation(
                    f"camera {name!r}: got {image.shape[:2]}, want {track.masks[0].shape} as at reset; keep its size"
                )
            views.append((image, track))
        return views

    def _changed(self, obs: Obs) -> Obs:
        cameras = dict(obs.cameras)
        for name, track in self._begun().items():
            height, width = cameras[name].shape[:2]
            mask = track.shown((height, width), self.config.keep_lost, self.config.grow)
            cameras[name] = self.background.behind(cameras[name], mask)
        return replace(obs, cameras=cameras)

    def _told(self, act: Act) -> Act:
        return replace(act, info={**act.info, INFO: self._report()})

    def _report(self) -> Mapping[str, Any]:
        return {
            name: {"seen": track.seen, "missing": track.missing, "searched": track.searched}
            for name, track in self._begun().items()
        }

    def _begun(self) -> dict[str, Track]:
        if self.tracks is None:
            raise NotReset("arro: act before reset; call reset(obs, instruction) first")
        return self.tracks
