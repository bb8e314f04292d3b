"""Scores of trajectories, labels and maps. Files are read in `files` and `folders` alone."""
