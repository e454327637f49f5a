"""LeRobot's asynchronous inference: its gRPC messages, and the pickles in them, which are read as data."""
