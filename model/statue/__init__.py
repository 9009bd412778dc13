"""Animated Statues: one scan becomes a control mesh, a displacement map over it and a skeleton that moves both.

control       the control model: mesh, skeleton, chart; the generic humanoid
registration  features, found or clicked, then the shape-constrained surface
detail        displacement map, texture, subdivision, reconstruction
motion        motions of other skeletons
fit.py        all of it in one function; files, report, commands: what the commands write

[Statues]
"""
