"""Scores of trajectories, labels and maps: they read arrays; `files` and `folders` read files."""
