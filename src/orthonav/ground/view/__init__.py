"""A run as a page in the browser, and the local server of that page."""
