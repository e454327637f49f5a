"""The rollout workers: Ray actors that play episodes."""
