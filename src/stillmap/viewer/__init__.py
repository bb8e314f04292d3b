"""A result to look at in a browser: what is shown of it, and the page that shows it."""
