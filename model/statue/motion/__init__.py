"""Motions for a statue: of its own parts and of other skeletons."""
