"""Tiles: representations of images, their embeddings, and the search by scalar product."""
