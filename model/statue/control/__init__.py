"""The control model: mesh, skeleton, chart; the generic humanoid; control models of others."""
