"""The writer of LeRobotDatasets v3.0, for recordings of robots and of servers and for exports of
evaluations.

It needs no more than the light install of a robot and the extra "record".
"""
