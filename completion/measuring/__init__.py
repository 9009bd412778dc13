"""The command `scape measure`: measure bodies from files, in a table and on a page."""
