"""Anatomical landmarks and motion-capture markers as vertices of the shared topology."""
from __future__ import annotations

from .population import population


def landmarks() -> dict[str, int]:
    """Return name -> vertex of the anatomical landmarks."""
    return dict(population().landmarks)


def markers() -> dict[str, int]:
    """Return label -> vertex of 41 motion-capture markers, labelled as in the CMU recordings."""
    return dict(population().markers)
