"""The same model with fewer or more triangles."""
