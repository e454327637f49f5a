"""The messages of the package `vlagents`: RPyC with text."""
