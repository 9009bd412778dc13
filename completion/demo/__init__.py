"""The whole chain on the embedded people, with its errors against the ground truth."""
