"""Anatomical landmarks and motion-capture markers as vertices of the shared topology."""
from __future__ import annotations

from .population import population


def landmarks() -> dict[str, int]:
    """Name -> vertex of the anatomical landmarks."""
    return dict(population().landmarks)


def markers() -> dict[str, int]:
    """Label -> vertex of a set of 41 motion-capture markers, labelled as in the CMU recordings."""
    return dict(population().markers)
