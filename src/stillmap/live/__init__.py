"""Mapping while the robot drives: poses, P(static) and map from what is known so far."""
