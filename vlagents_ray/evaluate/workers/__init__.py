"""The rollout workers: Ray actors that run episodes."""
