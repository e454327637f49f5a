"""The network of the reference policy."""

# mypy: disable-error-code="misc"
# mypy does not read torch's types (pyproject.toml). It therefore treats torch's classes as `Any`,
# and its check for subclasses of `Any` is disabled here.

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu, silu

from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.policies.reference.checkpoint import CAMERAS, WEIGHTS, NetworkSizes
from vlagents_ray.weights.safetensors import read_values

_TIMES = 32  # frequencies of the flow's time, from 1 to 1000 rad
# Added to the variance of a patch, so that noise in an empty patch is not amplified.
_CONTRAST = 1e-2
# Attention score of an image token whose key equals the query.
_SHARPNESS = 12.0


def _mlp(width: int) -> nn.Sequential:
    return nn.Sequential(
        nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
    )


def _inverse_norms(vectors: Tensor) -> Tensor:
    return (vectors.square().sum(-1, keepdim=True) + 1e-6).rsqrt()


class _Eye(nn.Module):
    """Encodes a camera's images as tokens, and computes from the tokens the keys and values for
    each `_Look`.

    Patches are normalised before and after their projection (arXiv 2302.01327), since they differ
    in few pixels.
    """

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        width, pixels = sizes.token_width, 3 * sizes.patch**2
        self.cut = nn.Unfold(
            sizes.patch, padding=(sizes.patch - sizes.stride) // 2, stride=sizes.stride
        )
        self.patches = nn.Sequential(
            nn.LayerNorm(pixels, _CONTRAST), nn.Linear(pixels, width), nn.LayerNorm(width)
        )
        self.places = nn.Parameter(0.02 * torch.randn((sizes.side // sizes.stride) ** 2, width))
        self.mix = _mlp(width)
        self.keys = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 2 * sizes.looks * width))

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        """Encode images, (P, 3, S, S).

        Returns:
            The keys of the first look, the values of the first look, the keys of the second look,
            and so on, each (P, tokens, width).
        """
        tokens = self.patches(self.cut(images).transpose(1, 2)) + self.places
        tokens = tokens + self.mix(tokens)
        return self.keys(tokens).split(tokens.shape[-1], -1)  # type: ignore[no-any-return]


class _Look(nn.Module):
    """Attention of each query to the tokens of all cameras and their positions."""

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.ask = nn.Sequential(
            nn.LayerNorm(sizes.width), nn.Linear(sizes.width, len(CAMERAS) * sizes.token_width)
        )
        self.answer = nn.Linear(len(CAMERAS) * (sizes.token_width + 2), sizes.width)
        self.among = nn.Linear(sizes.queries, sizes.queries)
        self.mix = _mlp(sizes.width)

    def forward(
        self, queries: Tensor, cameras: Sequence[tuple[Tensor, Tensor]], grid: Tensor
    ) -> Tensor:
        """Return the queries after they have attended to the images.

        Args:
            queries: (P, queries, width).
            cameras: The keys and values of each camera, (P, tokens, width).
            grid: The positions of the tokens, (tokens, 2).
        """
        answers = []
        camera_queries = self.ask(queries).chunk(len(cameras), -1)
        for camera_query, (keys, values) in zip(camera_queries, cameras, strict=True):
            products = camera_query @ keys.transpose(1, 2)
            cosines = products * _inverse_norms(camera_query) * _inverse_norms(keys).transpose(1, 2)
            scores = (_SHARPNESS * cosines).softmax(-1)
            answers += [scores @ values, scores @ grid.to(scores.dtype)]

        queries = queries + self.answer(torch.cat(answers, -1))
        queries = queries + self.among(queries.transpose(1, 2)).transpose(1, 2)
        return queries + self.mix(queries)


class _Block(nn.Module):
    """A layer of the flow's network. Its condition scales and shifts the values."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width, elementwise_affine=False)
        self.condition = nn.Linear(width, 2 * width)
        self.up, self.down = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, hidden: Tensor, condition: Tensor) -> Tensor:
        scale, shift = self.condition(condition).chunk(2, -1)
        return hidden + self.down(gelu(self.up(self.norm(hidden) * (1 + scale) + shift)))


class ReferenceNetwork(nn.Module):
    """The network of the reference policy, which computes the velocity of a flow.

    Queries attend to the words of the instruction, so that each query represents an object or an
    action in the instruction. The queries then attend to the images twice. The attention of a query
    to a camera's tokens yields the content and the position of the represented object. All queries
    and the robot's state form the context, from which a small network computes the velocity (arXiv
    2210.02747).
    """

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.sizes, width = sizes, sizes.width
        self.words = nn.Embedding(sizes.words + 1, width)
        self.order = nn.Parameter(0.02 * torch.randn(sizes.longest, width))
        self.queries = nn.Parameter(0.5 * torch.randn(sizes.queries, width))
        self.read, self.understand = nn.Linear(width, 2 * width), _mlp(width)
        self.feel = nn.Sequential(nn.Linear(sizes.state, width), nn.GELU(), nn.Linear(width, width))
        self.eyes = nn.ModuleList(_Eye(sizes) for _ in CAMERAS)
        self.looks = nn.ModuleList(_Look(sizes) for _ in range(sizes.looks))
        self.context = nn.Linear(sizes.queries * width + sizes.state, 2 * sizes.head)
        self.noisy = nn.Linear(sizes.horizon * sizes.action, sizes.head)
        self.when = nn.Sequential(
            nn.Linear(2 * _TIMES, sizes.head), nn.SiLU(), nn.Linear(sizes.head, sizes.head)
        )
        self.why = nn.Linear(2 * sizes.head, sizes.head)
        self.blocks = nn.ModuleList(_Block(sizes.head) for _ in range(sizes.blocks))
        self.result = nn.Linear(sizes.head, sizes.horizon * sizes.action)
        if sizes.longest_prefix:
            self.given = nn.Sequential(
                nn.Linear(sizes.horizon * (sizes.action + 1), sizes.head),
                nn.SiLU(),
                nn.Linear(sizes.head, 2 * sizes.head),
            )
            # At the start of its training, the network ignores the given rows.
            nn.init.zeros_(self.given[2].weight)
            nn.init.zeros_(self.given[2].bias)
        steps = torch.linspace(-1, 1, sizes.side // sizes.stride)
        positions = torch.cartesian_prod(steps, steps).flip(-1)  # (tokens, 2): x, y
        self.register_buffer("grid", positions, persistent=False)

    def encode(self, tokens: Tensor, state: Tensor, *images: Tensor) -> Tensor:
        """Return the context, (P, 2 * head); see `features` for the arguments."""
        return self.context_of(self.features(tokens, state, *images))

    def context_of(self, features: Tensor) -> Tensor:
        """Return the context of the result of `features`, (P, 2 * head)."""
        return silu(self.context(features))

    def features(self, tokens: Tensor, state: Tensor, *images: Tensor) -> Tensor:
        """Return all queries after they have attended to the words and the images, and the state,
        (P, queries * width + S).

        Args:
            tokens: The words of the instructions, (P, L) int64; 0 is padding.
            state: (P, S).
            images: The images of each camera, (P, 3, S, S) in [-1, 1].
        """
        words = self.words(tokens) + self.order
        keys, values = self.read(words).chunk(2, -1)
        scores = self.queries @ keys.transpose(1, 2) / math.sqrt(self.sizes.width)
        attention = scores.masked_fill(tokens[:, None] == 0, -math.inf).softmax(-1)
        queries = self.queries + attention @ values
        queries = queries + self.understand(queries) + self.feel(state)[:, None]

        encoded = [eye(image) for eye, image in zip(self.eyes, images, strict=True)]
        for number, look in enumerate(self.looks):
            cameras = [camera[2 * number : 2 * number + 2] for camera in encoded]
            queries = look(queries, cameras, self.grid)
        return torch.cat([queries.flatten(1), state], -1)

    def with_prefixes(self, context: Tensor, actions: Tensor, frozen: Tensor) -> Tensor:
        """Return the context of chunks that begin with given rows, (B, 2 * head).

        The context of a chunk without given rows is not changed.

        Args:
            context: The context of each chunk, (B, 2 * head).
            actions: Chunks whose first rows are given, (B, H, D). The other rows are not read.
            frozen: 1.0 for given rows, 0.0 for other rows, (B, H, 1).
        """
        rows = torch.cat([frozen, actions * frozen], -1).flatten(1).to(context.dtype)
        has_prefix = frozen[:, 0].to(context.dtype)
        return context + has_prefix * self.given(rows)

    def velocity(self, context: Tensor, actions: Tensor, times: Tensor) -> Tensor:
        """Return the velocity, noise minus actions, (B, H, D).

        Args:
            context: The context of each row, (B, 2 * head), from `encode` or `with_prefixes`.
            actions: The noisy actions, (B, H, D).
            times: The flow times, (B,); 1 is noise.
        """
        # The rates are not a buffer, since a bfloat16 network would round the largest rate by
        # several rad.
        angles = times[:, None].float() * torch.logspace(0, 3, _TIMES, device=times.device)
        when = torch.cat([angles.sin(), angles.cos()], -1).to(context.dtype)
        condition = silu(self.why(context) + self.when(when))
        hidden = self.noisy(actions.flatten(1))
        for block in self.blocks:
            hidden = block(hidden, condition)
        return self.result(hidden).unflatten(-1, actions.shape[1:])


def flow_velocity(
    network: ReferenceNetwork, inputs: Mapping[str, Tensor]
) -> Callable[[Tensor, float], Tensor]:
    """Return the function that computes the velocity of a flow, for a learner.

    The inputs are encoded once.

    Args:
        network: The network.
        inputs: "tokens" (B, L), "images" (B, cameras, 3, S, S) as `pixels` returns them, and
            "state" (B, S).
    """
    context = network.encode(inputs["tokens"], inputs["state"], *inputs["images"].unbind(1))

    def velocity(actions: Tensor, time: float) -> Tensor:
        """Return the velocity at noisy actions, (B, H, D), and a flow time."""
        return network.velocity(context, actions, actions.new_full((len(actions),), time))

    return velocity


def read_network(sizes: NetworkSizes, folder: Path) -> ReferenceNetwork:
    """Return a network with the weights of a checkpoint.

    Raises:
        ConfigError: The weights are damaged, or belong to another network.
    """
    network = ReferenceNetwork(sizes)
    try:
        with (folder / WEIGHTS).open("rb") as file:
            values = read_values(file)
        tensors = {name: torch.from_numpy(value.copy()) for name, value in values.items()}
        network.load_state_dict(tensors)
    except (VLAgentsError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:300]
        raise ConfigError(
            f"{folder / WEIGHTS}: cannot be read: {reason}; copy the checkpoint again"
        ) from error
    return network
