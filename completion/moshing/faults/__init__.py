"""What is wrong with markers, and sequences put right."""
