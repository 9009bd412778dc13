"""The detail of a scan as images over the control model, and the surface made of them again."""
