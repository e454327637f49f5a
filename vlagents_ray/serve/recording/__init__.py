"""The recording of a server's sessions as LeRobotDatasets."""
