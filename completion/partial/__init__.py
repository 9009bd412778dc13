"""A partial scan becomes a whole body."""
