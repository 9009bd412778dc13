"""Motions for a statue: of its own parts, of other skeletons, of a learned model."""
