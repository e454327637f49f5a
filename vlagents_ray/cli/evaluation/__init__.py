"""`vlagents-ray eval`, and the commands that read its results."""
