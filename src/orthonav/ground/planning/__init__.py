"""Routes, search bands, sheets, and what suits a camera and a height."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
