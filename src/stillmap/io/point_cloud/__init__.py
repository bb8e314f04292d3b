"""Readers and writers of point clouds: single files, or folders of one file per scan."""
