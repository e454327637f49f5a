"""Figures after measuring: the README's section of them, what they depend on, and two files side by side."""
