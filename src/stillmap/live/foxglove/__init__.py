"""A live mapper seen in Foxglove or Lichtblick: a WebSocket server in a process of its own."""
