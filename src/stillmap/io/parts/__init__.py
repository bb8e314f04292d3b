"""Parts of one run: recognised by stamps and odometry, and read as one recording."""
