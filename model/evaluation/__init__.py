"""How good a body model is: held-out errors, compactness, specificity, random bodies, and a page of them."""
