"""Models: of the place without its people, and of the people."""
