"""Two lasers on one robot: a planar one finds what moves, a tilting one builds in 3D."""
