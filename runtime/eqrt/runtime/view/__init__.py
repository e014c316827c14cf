"""Watching the service: a page in a browser, a table in a terminal. Needs the extra `view`."""
