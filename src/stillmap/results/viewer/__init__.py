"""`stillmap view`: a result folder in the browser, through viser."""
