"""A folder of scans: what is in it, one scan after another or many at once, and the page of the set."""
