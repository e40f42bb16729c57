"""Methods of Di Piazza et al. 2024 and of later work; `docs/paper.md` maps the paper's sections.

Encoders and words are learned here before the flight, with PyTorch or faiss; `orthonav.core.tiles`
runs them on board. Of this package, only `segments` and `caevl_recipe` are used in flight.
"""
