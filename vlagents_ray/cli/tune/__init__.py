"""The command `vlagents-ray tune`."""
