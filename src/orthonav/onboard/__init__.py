"""On board: locating the views of a flight, live or recorded."""
