"""The protocol of vlagents 0.2 and 0.3: RPyC, with images in shared memory, on its own port."""
