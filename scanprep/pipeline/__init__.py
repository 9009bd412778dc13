"""From a folder of scans to a registered set: one task per scan, and the page of the set."""
