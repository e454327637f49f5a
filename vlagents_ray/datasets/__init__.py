"""The writer of LeRobotDatasets v3.0, for recordings of robots and servers and for exports of
evaluations.

It needs only the light install of a robot and the extra "record".
"""
