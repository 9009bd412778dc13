"""Learning body models from registered meshes."""
