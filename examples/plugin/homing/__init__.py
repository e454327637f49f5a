"""A policy for vlagents-ray, a part of its server, and a command."""
