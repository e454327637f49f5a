"""Open-loop evaluation: a policy's actions on the observations of a LeRobotDataset, compared with the recorded ones."""
