"""Motions of files, ours and those of others, and how they come onto other skeletons."""
