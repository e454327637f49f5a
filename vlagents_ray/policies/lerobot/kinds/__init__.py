"""How each type of LeRobot's policies computes the chunks of many sessions."""
