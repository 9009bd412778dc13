"""What tests of faults of markers share."""
from completion.mocap.artefacts.results import ArtefactConfig

FRAMES, RATE = 160, 100.0
CONFIG = ArtefactConfig()
LABELS = tuple(f"M{i}" for i in range(30))


def exchanged(positions, a, b, begin, end):
    positions[begin:end + 1, [a, b]] = positions[begin:end + 1, [b, a]]
