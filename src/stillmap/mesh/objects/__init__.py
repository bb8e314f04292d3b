"""Models of moving objects: segmentation, merging, registration, reconstruction, texturing."""
