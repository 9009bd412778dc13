"""Depth pictures, and the person in them."""
