"""`report.html` of a place."""
