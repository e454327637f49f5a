"""The options `--policy.…` of the policy type `vlagents`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from lerobot.configs.policies import PreTrainedConfig

from vlagents_ray.errors import ConfigError

TRAINING = (
    "policy.type=vlagents: expected a policy whose weights are here, got one on a server; train "
    "with the type of the checkpoint that the server loads, or push weights into the server "
    "(docs/weights.md)"
)


@PreTrainedConfig.register_subclass("vlagents")
@dataclass
class VlagentsConfig(PreTrainedConfig):
    """The server, and the mapping of the policy's cameras and states to those of this robot or
    environment.
    """

    url: str = ""  # http(s)://HOST:PORT[/APP], as of `RemoteAgent`
    # policy's camera -> robot's, where the names differ.
    cameras: dict[str, str] = field(default_factory=dict)
    # The policy's parts in `observation.state`, in its order.
    state: list[str] = field(default_factory=list)
    instruction: str | None = None  # in place of the task of the dataset or the environment
    # Rows of each chunk that are executed; None: all that the server returns.
    n_action_steps: int | None = None
    checkpoint: str | None = None  # one of those that the server offers; None: its own
    # Seed of the first session's first episode; each further episode has the next number.
    seed: int | None = None
    key_file: Path | None = None  # holds the API key; without it, VLAGENTS_RAY_API_KEY is the key
    ca: Path | None = None  # https: PEM file of the server's authorities; None: the system's
    # https: PEM files of the client's certificate and its key.
    certificate: list[Path] = field(default_factory=list)
    transport: str = "auto"  # as of `RemoteAgent`
    codec: str = "auto"  # codec of images, as of `RemoteAgent`: "jpeg", "lossless", "raw", …
    priority: str = "robot"  # "simulation": robots of the same server go first
    # Move a robot although the training's statistics do not fit it; the log shows it.
    ignore_mismatch: bool = False
    timeout_s: float = 30.0  # for a request; after it the command ends with an error
    connect_timeout_s: float = 60.0  # for a server that is still loading
    device: str | None = "cpu"  # device of observations until they are sent
    push_to_hub: bool = False

    def __post_init__(self) -> None:
        """Check what can be checked without the server; raises `ConfigError`."""
        super().__post_init__()
        if self.n_obs_steps != 1:
            raise ConfigError(
                "policy.n_obs_steps: expected 1, as the server keeps the history, got "
                f"{self.n_obs_steps}"
            )
        if self.n_action_steps is not None and self.n_action_steps < 1:
            raise ConfigError(
                "policy.n_action_steps: expected 1 or more, or null for all, got "
                f"{self.n_action_steps}"
            )
        if len(self.certificate) not in (0, 2):
            raise ConfigError(
                "policy.certificate: expected two files, as [cert.pem, key.pem], got "
                f"{len(self.certificate)}"
            )

    @property
    def api_key(self) -> str | None:
        """The API key in `key_file`; None if no file is set. Raises `ConfigError` if it cannot
        be read.
        """
        if self.key_file is None:
            return None
        try:
            return self.key_file.read_text().strip()
        except OSError as error:
            raise ConfigError(
                f"policy.key_file: expected a file with an API key, got {str(self.key_file)!r} "
                f"({error})"
            ) from error

    @property
    def observation_delta_indices(self) -> None:
        """None, as one observation is sent at a time."""

    @property
    def action_delta_indices(self) -> None:
        """None, as nothing is trained here."""

    @property
    def reward_delta_indices(self) -> None:
        """None, as nothing is trained here."""

    def validate_features(self) -> None:
        """Do nothing: the policy compares the features with the server's contract."""

    def get_optimizer_preset(self) -> NoReturn:
        """Raise an error, as the policy cannot be trained here."""
        raise ConfigError(TRAINING)

    def get_scheduler_preset(self) -> Any:
        """Return None, as nothing is trained here."""
        return None
