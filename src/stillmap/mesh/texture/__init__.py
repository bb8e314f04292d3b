"""Texturing: visibility, occlusion, view selection, exposure, atlas, baking."""
