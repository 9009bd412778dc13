"""The command `scape measure`: bodies from files, their measurements in a table and on a page."""
