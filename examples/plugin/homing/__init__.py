"""A plug-in for vlagents-ray with a policy, a part of its server, and a command."""
