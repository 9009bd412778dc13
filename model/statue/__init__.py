"""Animated Statues: one scan becomes a control mesh, a displacement map over it and a skeleton that moves both.

control model -> registration by features -> shape-constrained fit -> displacement map -> reconstruction, animation

[Statues]
"""
