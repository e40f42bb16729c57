"""Views of real ground: relief, houses, trees, real lenses, recorded flights; and its gate."""
