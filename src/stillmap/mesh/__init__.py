"""Meshes of 3D recordings: the static surface, its texture, object models and point colors."""
