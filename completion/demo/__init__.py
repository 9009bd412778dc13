"""The whole chain on the built-in people, with its errors against the ground truth."""
