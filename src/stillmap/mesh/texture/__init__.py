"""What a mesh looks like: pictures, what they show of it, and which of them paints what."""
