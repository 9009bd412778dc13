"""`scape mosh`: folders of recordings, files and pages."""
