"""The cross-entropy method over a world model, for many sessions at once.

It follows upstream's `cem` step by step, except that all sessions and samples are computed together
and that the standard normal draws are arguments. An action is a change of pose, (7,): metres along
x, y, z, three rotations that are always zero, and the change of the gripper's closedness.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from vlagents_ray.policies.vjepa2_ac.network import VJepa2AcConfig
from vlagents_ray.registry import require

Tensor = Any  # torch's
World = Callable[[Tensor, Tensor, Tensor], Tensor]
"""A function of features (M, T, N, F), actions (M, T, 7) and poses (M, T, 7): the next frame's features, (M, N, F)."""

DRAWN = 4  # numbers of an action that are sampled: x, y, z and the gripper
_GRIPPER_RANGE = 0.75  # largest change of the gripper in a step
_GRIPPER_REST = 0.25  # smaller changes become zero


@dataclass(frozen=True, slots=True)
class Plans:
    """The plans of all sessions."""

    actions: Tensor  # (B, H, 7)
    std: Tensor  # (B, H, 7), of the last distribution
    energy: Tensor  # (B,), distance of the last iteration's best plan from the goal


def plan(world: World, features: Tensor, poses: Tensor, goals: Tensor, noise: Tensor, config: VJepa2AcConfig) -> Plans:
    """Search plans from `features` (B, N, F) and `poses` (B, 7) to `goals` (B, N, F), with `noise` (B, I, H, S, 4)."""
    torch = require("torch")
    mean = torch.zeros(len(poses), config.rollout, DRAWN, device=poses.device)
    std = torch.ones_like(mean)
    std[..., :3] = config.maxnorm
    keep_mean = _momentum(mean, config.momentum_mean, config.momentum_mean_gripper)
    keep_std = _momentum(mean, config.momentum_std, config.momentum_std_gripper)
    energy = torch.zeros(len(poses), 0)
    for draws in noise.unbind(1):
        tried = _bounded(draws * std[:, :, None] + mean[:, :, None], config)  # (B, H, S, 4)
        energy = _energies(world, features, poses, goals, _actions(tried.transpose(1, 2)), config.plans_a_pass)
        best = energy.topk(config.topk, largest=False).indices  # (B, K)
        chosen = tried.gather(2, best[:, None, :, None].expand(-1, config.rollout, -1, DRAWN))
        mean = chosen.mean(2) * (1 - keep_mean) + mean * keep_mean
        std = chosen.std(2) * (1 - keep_std) + std * keep_std
    gripper = mean[..., 3:]
    rested = torch.cat([mean[..., :3], torch.where(gripper.abs() < _GRIPPER_REST, 0.0, gripper)], -1)
    return Plans(_actions(rested), _actions(std), energy.min(1).values)


def _momentum(like: Tensor, position: float, gripper: float) -> Tensor:
    return like.new_tensor([position] * 3 + [gripper])


def _bounded(tried: Tensor, config: VJepa2AcConfig) -> Tensor:
    """Limit sampled actions, (B, H, S, 4), to the largest change in one step."""
    torch = require("torch")
    position = tried[..., :3].clip(-config.maxnorm, config.maxnorm)
    gripper = tried[..., 3:].clip(-_GRIPPER_RANGE, _GRIPPER_RANGE)
    if config.close_gripper is not None:
        gripper[:, config.close_gripper :] = 1.0
    return torch.cat([position, gripper], -1)


def _actions(drawn: Tensor) -> Tensor:
    """Expand sampled actions (..., 4) to (..., 7), without rotation."""
    torch = require("torch")
    return torch.cat([drawn[..., :3], torch.zeros_like(drawn[..., :3]), drawn[..., 3:]], -1)


def _energies(world: World, features: Tensor, poses: Tensor, goals: Tensor, actions: Tensor, most: int) -> Tensor:
    """Compute the mean absolute difference (B, S) between the goal and the prediction for actions (B, S, H, 7)."""
    torch = require("torch")
    sessions, samples, horizon = actions.shape[:3]
    flat = actions.flatten(0, 1)
    owner = torch.arange(sessions, device=poses.device).repeat_interleave(samples)
    found = []
    for tried, whose in zip(flat.split(most), owner.split(most), strict=True):
        frames, path = features[whose][:, None], poses[whose][:, None]
        for step in range(horizon):
            following = world(frames, tried[:, : step + 1], path)
            frames = torch.cat([frames, following[:, None]], 1)
            path = torch.cat([path, moved(path[:, -1], tried[:, step])[:, None]], 1)
        found.append((frames[:, -1] - goals[whose]).abs().flatten(1).mean(1))
    return torch.cat(found).view(sessions, samples)


def moved(poses: Tensor, actions: Tensor) -> Tensor:
    """Apply actions (M, 7) to poses (M, 7): x, y, z, Euler angles about fixed x, y, z, closedness."""
    torch = require("torch")
    rotation = _matrices(actions[:, 3:6].double()) @ _matrices(poses[:, 3:6].double())
    angles = _angles(rotation).to(poses.dtype)
    closedness = (poses[:, 6:] + actions[:, 6:]).clip(0, 1)
    return torch.cat([poses[:, :3] + actions[:, :3], angles, closedness], -1)


def _matrices(angles: Tensor) -> Tensor:
    """Convert Euler angles (M, 3) about fixed x, y, z to matrices (M, 3, 3)."""
    torch = require("torch")
    (sx, sy, sz), (cx, cy, cz) = angles.sin().unbind(-1), angles.cos().unbind(-1)
    rows = (
        (cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx),
        (sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx),
        (-sy, cy * sx, cy * cx),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _angles(matrices: Tensor) -> Tensor:
    """Convert matrices to Euler angles, the second in [-pi/2, pi/2]; at these bounds the third is zero."""
    torch = require("torch")
    level = torch.hypot(matrices[:, 0, 0], matrices[:, 1, 0])
    second = torch.atan2(-matrices[:, 2, 0], level)
    locked = level < 1e-7
    first = torch.where(
        locked,
        torch.atan2(-matrices[:, 1, 2], matrices[:, 1, 1]),
        torch.atan2(matrices[:, 2, 1], matrices[:, 2, 2]),
    )
    third = torch.where(locked, 0.0, torch.atan2(matrices[:, 1, 0], matrices[:, 0, 0]))
    return torch.stack([first, second, third], -1)
