"""Pickles that other systems send or keep, read as data and written without their classes: nothing is unpickled."""
