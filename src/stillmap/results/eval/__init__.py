"""Scores of trajectories, labels, maps, objects and models against truth."""
