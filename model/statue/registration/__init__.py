"""The control model brought onto a scan: features, found or clicked, then the shape-constrained surface."""
