"""A run as a page in the browser: a small server of this computer's own, and what it serves."""
