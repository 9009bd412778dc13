"""Markers of a person move a body."""
