"""A body brought to its registered vertices, to named points, or to a scan of some of it."""
