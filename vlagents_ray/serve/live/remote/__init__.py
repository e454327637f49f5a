"""A human at the live page moves a robot: from his WebSocket to that of the robot, whichever replica has it."""
