"""Open-loop evaluation: what a policy would have done where a LeRobotDataset says what was done."""
