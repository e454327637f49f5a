"""LeRobot's asynchronous inference over gRPC, on its own port."""
