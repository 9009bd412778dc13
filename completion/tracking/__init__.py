"""Marker-less capture: the motion of a body from frames of points."""
