"""What tests of faults of markers share."""
FRAMES, RATE = 160, 100.0
LABELS = tuple(f"M{i}" for i in range(30))


def exchanged(positions, a, b, begin, end):
    positions[begin:end + 1, [a, b]] = positions[begin:end + 1, [b, a]]
