"""Two lasers on one robot: a planar laser labels moving objects, a tilting laser maps in 3D."""
