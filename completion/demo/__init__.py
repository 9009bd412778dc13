"""The whole chain on the synthetic people, with its errors against the ground truth."""
