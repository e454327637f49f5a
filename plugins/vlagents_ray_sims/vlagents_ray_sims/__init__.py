"""Benchmarks in simulation: LIBERO, robosuite, CALVIN, SIMPLER, RoboCasa, RCS, ALOHA and
Meta-World.
"""
