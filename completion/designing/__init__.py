"""Which markers, and which frames, tell most about a body [MoSh]."""
