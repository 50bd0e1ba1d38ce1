"""Which box is of which quadric, and where a camera is that sees known ones."""
