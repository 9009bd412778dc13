"""Aids for posing: by angles, mirrored, within limits, and any registered body in other poses."""
