"""How good a body model is: held-out errors, compactness, and random bodies."""
