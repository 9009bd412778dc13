"""What `scape view` shows, and how it moves."""
