"""Point clouds, in folders of many or in single files, as recordings."""
