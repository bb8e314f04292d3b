"""What stands still, as a mesh: polygons of range images, merged, thinned out."""
