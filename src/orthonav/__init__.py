"""orthonav: position fixes for aircraft without GNSS from a camera and an orthophoto."""

__version__ = "0.1.0"
