"""Places: several sessions (recordings) of one place, aligned and merged into one map with dated
changes."""
