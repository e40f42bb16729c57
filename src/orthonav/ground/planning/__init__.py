"""Plans: areas, routes and their file formats, sheets, spacing of tiles, terrain along a route."""
