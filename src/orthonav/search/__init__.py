"""Search: which stored embeddings are most like the one of a view."""
