"""The options `--policy.…` of the policy type `vlagents`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from lerobot.configs.policies import PreTrainedConfig

from vlagents_ray.errors import ConfigError

TRAINING = (
    "policy.type=vlagents: expected a policy whose weights are on this machine, got a policy on a "
    "server; train "
    "with the type of the checkpoint that the server loads, or push weights into the server "
    "(docs/weights.md)"
)


@PreTrainedConfig.register_subclass("vlagents")
@dataclass
class VlagentsConfig(PreTrainedConfig):
    """The settings of the server, and the mapping of the policy's cameras and states to those of
    this robot or environment.
    """

    url: str = ""  # URL of the server, http(s)://HOST:PORT[/APP], as for `RemoteAgent`
    # The robot's names of cameras by the policy's names, where the names differ.
    cameras: dict[str, str] = field(default_factory=dict)
    # The policy's parts of the state in `observation.state`, in the order of the vector.
    state: list[str] = field(default_factory=list)
    instruction: str | None = None  # replaces the task of the dataset or the environment
    # Number of rows of each chunk that are executed; None for all rows that the server returns.
    n_action_steps: int | None = None
    # Seed of the first session's first episode; the seed increases by one with each further
    # episode.
    seed: int | None = None
    # File that contains the API key; None uses the variable VLAGENTS_RAY_API_KEY.
    key_file: Path | None = None
    # For https: PEM file of the authorities for the server; None uses those of the system.
    ca: Path | None = None
    # For https: PEM files of the client's certificate and of its key.
    certificate: list[Path] = field(default_factory=list)
    transport: str = "auto"  # transport, as for `RemoteAgent`
    codec: str = "auto"  # codec of images, as for `RemoteAgent`: "jpeg", "lossless", "raw", …
    priority: str = "robot"  # with "simulation", robots of the same server have precedence
    # Whether to move a robot although the training's statistics do not fit it; the log shows this.
    ignore_mismatch: bool = False
    # Time limit of a request, s, after which the command ends with an error.
    timeout_s: float = 30.0
    connect_timeout_s: float = 60.0  # time limit for a server that is still loading, s
    device: str | None = "cpu"  # device of observations before they are sent
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
        """The API key in `key_file`; None if no file is set. Raises `ConfigError` if the file
        cannot be read.
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
