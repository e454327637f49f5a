"""Reports: the HTML page, the table in the terminal, progress."""
