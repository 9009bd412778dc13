"""A folder of scans to a registered set: one scan after another or many at once, and the page of the set."""
